"""What a driver measures: the features of an observation, with their ranges, units and resolutions."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from bench.plugins.contracts import Facts

ActionType = Literal["discrete", "continuous"]
Driver = Literal["agent", "idm"]
CONSTANT_CONTROLS = {"throttle": (1.0, 0.0), "coast": (0.0, 0.0), "brake": (-1.0, 0.0)}
"""[acceleration, steering] in [-1, 1] of the policies that always do the same, by name."""
RIGHT_THEN_SLOWER = "right_then_slower"
"""The policy that changes to the rightmost lane and then brakes."""


@dataclass(frozen=True)
class Features:
    """The measured features of an observation row, in order, with the range that maps to [-1, 1].

    An observation is a float tensor [B, V, F]: V vehicles (row 0 is the ego, absolute; the rest relative to it, nearest
    first, all zero where absent), F = 1 + len(names): `presence` in {0, 1}, then each measured feature over its range.

    Args:
        names: of the measured features.
        low, high: what -1 and 1 stand for, in `units`.
        units: for instance m and m/s.
        floors: the resolution of the sensor, in `units`: the smallest deviation of the `relative` set at a budget of 0.1;
            empty for none.
    """

    names: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    units: tuple[str, ...]
    floors: tuple[float, ...] = ()

    def half_range(self) -> Tensor:
        """[F - 1] physical units that one unit of the normalised observation stands for."""
        return (torch.tensor(self.high) - torch.tensor(self.low)) / 2


@dataclass(frozen=True, kw_only=True)
class DrivingFacts(Facts):
    """What a driver and its defences may know of their world.

    Args:
        features: of the observation.
        drivers: who may be at the wheel: `agent` obeys actions; `idm`, where there is one, is the world's own rule-based driver.
    """

    features: Features
    drivers: tuple[Driver, ...] = ("agent",)

    def blind_policies(self, action_type: ActionType) -> list[str]:
        """The names of the policies that ignore their input in this world: each constant action, and a sequence if it has one."""
        if action_type == "continuous":
            return list(CONSTANT_CONTROLS)
        constant = [name.lower() for name in self.actions]
        sequence = {"lane_right", "slower"} <= set(constant)
        return [*constant, RIGHT_THEN_SLOWER] if sequence else constant

    def written(self) -> dict[str, Any]:
        return super().written() | {"features": asdict(self.features), "drivers": list(self.drivers)}
