"""The features of a driving observation, with their ranges, units and resolutions."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor

from cavbench.core.contracts import Facts
from cavbench.driving.kinematics import Kinematics
from cavbench.driving.platooning import Platooning
from cavbench.driving.sets import Traffic
from cavbench.driving.surroundings import USUAL, Surroundings

ActionType = Literal["discrete", "continuous"]
Driver = Literal["agent", "idm", "clairvoyant"]


@dataclass(frozen=True, kw_only=True)
class Control:
    """How the car of an environment is driven.

    Args:
        action_type: discrete lane-changing actions, or continuous [acceleration, steering] in [-1, 1].
        driver: `agent` executes the actions; the others ignore them: `idm` is the world's own rule-based driver, `clairvoyant` a
            planner that knows its hidden state.
        action_repeat: number of frames for which a decision is held (training only). A lane change is sent once, other actions
            are repeated. Reward and progress are summed over the frames; an episode may end between them.
        traffic: bounds of the cars of the traffic that an attacker drives; None if it drives none.
        surroundings: how the traffic drives, and what the ego's body and the road do.
    """

    action_type: ActionType = "discrete"
    driver: Driver = "agent"
    action_repeat: int = 1
    traffic: Traffic | None = None
    surroundings: Surroundings = USUAL


CONSTANT_CONTROLS = {"throttle": (1.0, 0.0), "coast": (0.0, 0.0), "brake": (-1.0, 0.0)}
"""[acceleration, steering] in [-1, 1] of the constant policies, by name."""
CONTROLS = ("acceleration", "steering")
"""Names of the controls of a continuous action, unless a world has others."""
CONSTANT_SHARES = {"all_low": -1.0, "all_middle": 0.0, "all_high": 1.0}
"""Every control of the constant policies, by name, in a world with other controls."""
RIGHT_THEN_SLOWER = "right_then_slower"
"""The policy that changes to the rightmost lane and then brakes."""


@dataclass(frozen=True)
class Features:
    """The measured features of an observation row, in order, with the range that maps to [-1, 1].

    An observation is a float tensor [B, V, F]. Row 0 of the V vehicles is the ego, in absolute values; the other rows are
    relative to it, nearest first, and all zero if absent. F = 1 + len(names): `presence` in {0, 1}, then each measured feature,
    normalised by its range.

    Args:
        names: names of the measured features.
        low, high: values of -1 and 1, in `units`.
        units: for instance m and m/s.
        floors: resolution of the sensor, in `units`: the smallest radius of the `relative` set at a budget of 0.1; empty for
            none.
        fixed: names of the features that no attack can change, like `presence`: flags, one-hot codes, the clock.
        present: of each feature, the number of the feature without which there is nothing to measure, and no attack can change
            it: the presence of a car in a flat observation; -1 for none. Empty if all are always there.
        messages: number of the first row that other cars told by radio, and not a sensor; 0 if none is.

    Raises:
        ValueError: if `fixed` names a feature that there is not, or `present` is not a number for each feature.
    """

    names: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    units: tuple[str, ...]
    floors: tuple[float, ...] = ()
    fixed: tuple[str, ...] = ()
    present: tuple[int, ...] = ()
    messages: int = 0

    def __post_init__(self) -> None:
        if self.present and (
            len(self.present) != len(self.names) or not all(-1 <= place < len(self.names) for place in self.present)
        ):
            raise ValueError(
                "features.present is empty, or the number of a feature (-1 for none) for each of features.names"
            )
        if isinstance(self.fixed, str):
            raise ValueError(f"features.fixed is a tuple of names: write ({self.fixed!r},)")
        if strange := [name for name in self.fixed if name not in self.names]:
            raise ValueError(f"features.fixed names {strange[0]!r}, which is not one of features.names")

    @cached_property
    def _ends(self) -> tuple[Tensor, Tensor]:
        """[F - 1] ends of the ranges. Every copy of the features has tensors of its own: nobody writes to those of another."""
        return torch.tensor(self.low), torch.tensor(self.high)

    @cached_property
    def _scale(self) -> tuple[Tensor, Tensor]:
        """[F - 1] middles of the ranges, and half their sizes."""
        low, high = self._ends
        return (high + low) / 2, (high - low) / 2

    def forgeable(self) -> Tensor:
        """[F - 1] 1 for the features that an attack may change, 0 for those that are `fixed`."""
        return torch.tensor([float(name not in self.fixed) for name in self.names])

    def there(self, observation: Tensor) -> Tensor:
        """[..., F - 1] whether there is something to measure, of an observation [..., F] (`present`)."""
        places = torch.tensor(self.present)
        return (observation[..., 1:][..., places] > 0) | (places < 0)

    def written(self) -> dict[str, Any]:
        """As plain JSON values for records; without `fixed`, `present` and `messages` if there are none, as in older records."""
        later = ("fixed", "present", "messages")
        return {name: value for name, value in asdict(self).items() if name not in later or value}

    def half_range(self) -> Tensor:
        """[F - 1] size of one normalised unit, in physical units."""
        return self._scale[1].clone()

    def physical(self, observation: Tensor) -> Tensor:
        """[..., V, F - 1] the measured values of an observation [..., V, F], in physical units."""
        centre, half = (one.to(observation) for one in self._scale)
        return centre + observation[..., 1:] * half

    def normalised(self, physical: Tensor) -> Tensor:
        """[..., F - 1] values in physical units on the scale of observations: -1 and 1 are the ends of a range, not clipped."""
        low, high = (end.to(physical) for end in self._ends)
        return 2 * (physical - low) / (high - low) - 1


@dataclass(frozen=True, kw_only=True)
class LaneShape:
    """A lane from above.

    Args:
        width: in m.
        line: points x, y of its centre in m, in driving direction; y points to the right of x.
    """

    width: float
    line: tuple[tuple[float, float], ...]


@dataclass(frozen=True, kw_only=True)
class DrivingFacts(Facts):
    """The facts of a world that are given to driving policies and defences.

    Args:
        features: features of the observation.
        drivers: supported drivers: `agent` executes the policy's actions; `idm` is the world's own rule-based driver, if any, and
            `clairvoyant` a planner that knows the world's hidden state, if any.
        kinematics: how its cars move; None if the world does not say.
        flat: whether the observation is one row, which the world's own environment gives as an array in physical units.
        shape: shape of that array; empty for [F - 1].
        limits: the lowest and the highest value of each of its entries, in that environment; empty if nobody asked.
        rows: V, the number of rows in its observations; None if the world does not say.
        controls: names of the controls of a continuous action, each in [-1, 1]; empty if it takes none.
        unbounded: whether the world's own environment declares Box(-inf, inf) for values in [-1, 1], as highway-env does.
        lanes: the lanes of the road in a cell, for recordings; empty if they are straight, parallel and 4 m wide.
        platooning: how the cars of a platoon move and what they are told; None in other worlds.
        environment: the call that makes the world's gymnasium environment, for messages; empty if the world does not say.
    """

    features: Features
    drivers: tuple[Driver, ...] = ("agent",)
    kinematics: Kinematics | None = None
    flat: bool = False
    shape: tuple[int, ...] = ()
    limits: tuple[tuple[float, float], ...] = ()
    rows: int | None = None
    controls: tuple[str, ...] = CONTROLS
    unbounded: bool = False
    lanes: tuple[LaneShape, ...] = ()
    platooning: Platooning | None = None
    environment: str = ""

    def native(self, observation: Tensor) -> Tensor:
        """The observation [..., V, F] in the format of the world's own environment, which policies from outside expect.

        Itself or, if `flat`, the measured values in physical units, in row-major order: [..., F - 1], or [..., and `shape`].
        """
        if not self.flat:
            return observation
        measured = self.features.physical(observation).squeeze(-2)
        return measured.unflatten(-1, self.shape) if self.shape else measured

    def blind_policies(self, action_type: ActionType) -> list[str]:
        """Names of this world's input-independent policies: each constant action, and `right_then_slower` if possible."""
        if action_type == "continuous":
            return list(self.constant_controls())
        constant = [name.lower() for name in self.actions]
        sequence = {"lane_right", "slower"} <= set(constant)
        return [*constant, RIGHT_THEN_SLOWER] if sequence else constant

    def takes(self) -> str:
        """The actions of the world, in a message."""
        kinds = []
        if self.actions:
            kinds.append(f"{len(self.actions)} discrete ones ({', '.join(self.actions)})")
        if self.controls:
            kinds.append(f"{len(self.controls)} continuous ones ({' and '.join(self.controls)}, in [-1, 1])")
        return " or ".join(kinds)

    def constant_controls(self) -> dict[str, tuple[float, ...]]:
        """The controls of the constant policies, by name."""
        if self.controls == CONTROLS:
            return dict(CONSTANT_CONTROLS)
        return {name: (share,) * len(self.controls) for name, share in CONSTANT_SHARES.items()}

    def written(self) -> dict[str, Any]:
        values = super().written() | {
            "features": self.features.written(),
            "drivers": list(self.drivers),
        }
        # No report reads them.
        for name in ("kinematics", "shape", "limits", "rows", "unbounded", "lanes", "platooning", "environment"):
            del values[name]
        # As in records from before it.
        if self.controls in (CONTROLS, ()):
            del values["controls"]
        return values
