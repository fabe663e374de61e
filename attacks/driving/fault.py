"""Faults of sensors and actuators, without an adversary: nobody chooses what fails, or when."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.core.ranges import Natural
from cavbench.driving import DrivingAttack, Forgery
from cavbench.driving.invented import NEEDED
from cavbench.errors import UserError

if TYPE_CHECKING:
    from cavbench.driving import Features, Oracle, State

Mode = Literal["dropout", "ghosts", "latency", "freeze", "quantise", "drift", "noise", "late", "lost", "rude", "polite"]
DROPPED = (0.002, 0.01, 0.05)
"""Probability that a row is missing in a frame."""
APPEARING = (0.005, 0.02, 0.1)
"""Probability that an invented car appears in a frame, where there is room for one."""
LASTING_S = 0.5
"""An invented car is shown for so long, in s."""
LATE = (1, 2, 4)
"""Age of the frame that is shown, or delay of a command, in decisions."""
FREEZING = ((0.004, 5), (0.008, 10), (0.01, 15))
"""Probability that the sensor freezes in a frame, and for how many."""
STEPS = (2.0, 4.0, 8.0)
"""Step of the quantisation, and the drift after `RAMP_S`, in resolutions of the sensor."""
RAMP_S = 10.0
"""The drift grows for so long, in s."""
DEVIATION = (1.0, 2.0, 4.0)
"""Standard deviation of the noise, in resolutions of the sensor."""
MEMORY_S = 1.0
"""Time in which the correlation of the noise falls to 1 / e, in s."""
LOST = (0.05, 0.2, 0.5)
"""Probability that a command is lost in a frame."""
IDLE = 1
"""The discrete action of a car whose command is lost; a continuous one is 0."""
MANNERS: dict[str, tuple[dict[str, float], dict[str, float], dict[str, float]]] = {
    "rude": (
        {"time_gap": 1.0, "braking": 6.0, "lane_gain": 0.1, "imposed_braking": 3.0},
        {"time_gap": 0.6, "braking": 7.0, "lane_gain": 0.0, "imposed_braking": 5.0},
        {"time_gap": 0.3, "braking": 8.0, "lane_gain": -0.2, "imposed_braking": 8.0},
    ),
    "polite": (
        {"time_gap": 2.0, "braking": 4.0, "politeness": 0.3, "imposed_braking": 1.5},
        {"time_gap": 2.5, "braking": 3.0, "politeness": 0.6, "imposed_braking": 1.0},
        {"time_gap": 3.5, "braking": 2.0, "politeness": 1.0, "imposed_braking": 0.5},
    ),
}
"""How the traffic drives: fields of `cavbench.driving.Surroundings`, which the threat model must have."""
MEMORYLESS = ("dropout", "latency", "quantise", "late", "lost", *MANNERS)
"""Modes in which a frame does not depend on those before it."""
NEEDS: dict[str, tuple[str, ...]] = {
    "dropout": ("presence.hidden=9",),
    "ghosts": ("presence.invented=3",),
    "latency": ("latency.frames=4",),
    "freeze": ("held.longest=15",),
    "late": ("actuator.delay=4",),
    "lost": ("actuator.replaced=0.5",),
}


@dataclass(frozen=True, kw_only=True)
class Fault(DrivingAttack):
    """A fault of a sensor or an actuator, at one of three severities.

    The severities follow the corruptions of Hendrycks and Dietterich 2019: fixed numbers that are the same for every victim.
    What the threat model does not allow does not fail: the suite `faults` allows all of it.

    | mode | what fails | severity 1, 2, 3 |
    |---|---|---|
    | `dropout` | a row is missing in a frame | with probability 0.002, 0.01, 0.05 |
    | `ghosts` | a car that is not there is shown for 0.5 s | one appears with probability 0.005, 0.02, 0.1 a frame |
    | `latency` | the sensor is late | 1, 2, 4 decisions |
    | `freeze` | the sensor is frozen | begins with probability 0.004, 0.008, 0.01, lasts 5, 10, 15 decisions |
    | `quantise` | values are rounded | to 2, 4, 8 resolutions of the sensor |
    | `drift` | every sensor drifts for 10 s | by 2, 4, 8 resolutions |
    | `noise` | noise that is correlated over 1 s | with a deviation of 1, 2, 4 resolutions |
    | `late` | commands are executed late | 1, 2, 4 decisions |
    | `lost` | a command is lost, and the car idles | with probability 0.05, 0.2, 0.5 |
    | `rude` | other drivers keep a smaller time gap, brake late and push in | 1, 0.6, 0.3 s; 6, 7, 8 m/s2 |
    | `polite` | other drivers keep a larger time gap, brake early and let others in | 2, 2.5, 3.5 s; 4, 3, 2 m/s2 |

    The last two are the traffic of `threat.dynamics`, which must be that of the severity (`MANNERS`); nothing else fails.

    Args:
        mode: what fails.
        severity: 1, 2 or 3 (default 2).
        draw: number of the random draw.

    Shapes: observation [B, V, F] in, a `Forgery` out. It asks nothing.

    Example:
        >>> from cavbench.attacks.driving.fault import Fault
        >>> Fault(mode="dropout", severity=3).forges
        ('presence.hidden=9',)
    """

    access: ClassVar[Access] = "oblivious"
    joint: ClassVar[bool] = True

    mode: Mode = "dropout"
    severity: Literal[1, 2, 3] = 2
    draw: Natural = 0

    @property
    def forges(self) -> tuple[str, ...]:
        if self.mode in MANNERS:
            return (" threat.".join(f"dynamics.{name}={value:g}" for name, value in self.manners.items()),)
        return NEEDS.get(self.mode, ())

    @property
    def manners(self) -> dict[str, float]:
        """How the traffic drives: fields of `threat.dynamics`; none unless the fault is of other drivers."""
        return MANNERS[self.mode][self.severity - 1] if self.mode in MANNERS else {}

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        if wrong := [one for one in self.manners if getattr(oracle.threat.dynamics, one) != self.manners[one]]:
            raise UserError(
                f"severity {self.severity} of {self.mode} means threat.dynamics.{wrong[0]}={self.manners[wrong[0]]:g}, the "
                f"threat model has {getattr(oracle.threat.dynamics, wrong[0]):g}: attack=faults sets it"
            )
        if self.mode in MEMORYLESS:
            return None
        batch = observation.shape[:1]
        state = TensorDict({"step": torch.zeros(batch, dtype=torch.int64)}, batch_size=batch)
        if self.mode == "ghosts":
            state["cars"] = observation.new_zeros(*batch, oracle.threat.presence.invented, observation.shape[2])
            state["rest"] = torch.zeros(state["cars"].shape[:2], dtype=torch.int64)
            state["ego"] = observation[:, 0].clone()
        if self.mode == "freeze":
            state["age"] = state["rest"] = torch.zeros(batch, dtype=torch.int64)
        if self.mode == "drift":
            state["way"] = _uniform(oracle, observation.shape[2] - 1) * 2 - 1
        if self.mode == "noise":
            state["error"] = torch.zeros_like(observation[..., 1:])
        return state

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor | Forgery, State]:
        if self.mode in MANNERS:
            return observation, None
        if state is None:
            return getattr(self, f"_{self.mode}")(observation, oracle), None
        after = state.clone()
        after["step"] += 1
        return getattr(self, f"_{self.mode}")(observation, oracle, after), after

    def _dropout(self, observation: Tensor, oracle: Oracle) -> Forgery:
        missing = _uniform(oracle, observation.shape[1]) < DROPPED[self.severity - 1]
        missing[:, 0] = False
        missing &= observation[..., 0] > 0
        # No more than the threat model allows at once.
        missing &= missing.cumsum(1) <= oracle.threat.presence.hidden
        return Forgery(hidden=missing & (oracle.left("presence") > 0)[:, None])

    def _ghosts(self, observation: Tensor, oracle: Oracle, state: TensorDict) -> Forgery:
        cars, rest = state["cars"], state["rest"]
        appearing = (_uniform(oracle, rest.shape[1]) < APPEARING[self.severity - 1] / max(rest.shape[1], 1)) & (
            rest == 0
        )
        place = _uniform(oracle, rest.shape[1] * 4).reshape(*rest.shape, 4)
        rest.copy_(torch.where(appearing, round(LASTING_S / oracle.period), (rest - 1).clamp(min=0)))
        moved = _moved(cars, state["ego"], observation[:, 0], oracle)
        state["ego"] = observation[:, 0].clone()
        cars.copy_(torch.where(appearing[..., None], _placed(place, observation, oracle.features), moved))
        cars[..., 0] = ((rest > 0) & (oracle.left("presence") > 0)[:, None]).to(cars)
        return Forgery(invented=cars.clone())

    def _latency(self, observation: Tensor, oracle: Oracle) -> Forgery:
        # The run shows the first frame until there is one as old as that.
        return Forgery(age=torch.full((len(observation),), min(LATE[self.severity - 1], oracle.threat.latency.frames)))

    def _freeze(self, observation: Tensor, oracle: Oracle, state: TensorDict) -> Forgery:
        chance, frames = FREEZING[self.severity - 1]
        frames = min(frames, oracle.threat.held.longest)
        begins = (_uniform(oracle, 1)[:, 0] < chance) & (state["rest"] == 0) & (state["step"] > 1)
        state["rest"] = torch.where(begins, frames, (state["rest"] - 1).clamp(min=0))
        frozen = (state["rest"] > 0) & (oracle.left("held") > 0)
        state["age"] = torch.where(frozen, state["age"] + 1, 0)
        return Forgery(age=state["age"].clone())

    def _quantise(self, observation: Tensor, oracle: Oracle) -> Tensor:
        size = _resolution(oracle.features).to(observation) * STEPS[self.severity - 1]
        return _shifted(observation, (observation[..., 1:] / size).round() * size - observation[..., 1:], oracle)

    def _drift(self, observation: Tensor, oracle: Oracle, state: TensorDict) -> Tensor:
        grown = (state["step"] * oracle.period / RAMP_S).clamp(max=1.0).to(observation)
        size = _resolution(oracle.features).to(observation) * STEPS[self.severity - 1]
        return _shifted(observation, (grown[:, None] * state["way"].sign() * size)[:, None], oracle)

    def _noise(self, observation: Tensor, oracle: Oracle, state: TensorDict) -> Tensor:
        kept = torch.tensor(-oracle.period / MEMORY_S).exp()
        fresh = torch.cat([_normal(part, observation) for part in oracle.parts])
        state["error"] = kept * state["error"] + (1 - kept**2).sqrt() * fresh
        size = _resolution(oracle.features).to(observation) * DEVIATION[self.severity - 1]
        return _shifted(observation, size * state["error"], oracle)

    def _late(self, observation: Tensor, oracle: Oracle) -> Forgery:
        return Forgery(
            delay=torch.full((len(observation),), min(LATE[self.severity - 1], oracle.threat.actuator.delay))
        )

    def _lost(self, observation: Tensor, oracle: Oracle) -> Forgery:
        # The run replaces a command with the probability of the threat model.
        chance = LOST[self.severity - 1] / max(oracle.threat.actuator.replaced, LOST[self.severity - 1])
        lost = _uniform(oracle, 1)[:, 0] < chance
        if oracle.action_type == "discrete":
            return Forgery(action=torch.where(lost, IDLE, -1))
        return Forgery(action=torch.where(lost, 0.0, torch.nan)[:, None].expand(-1, 2))


def _uniform(oracle: Oracle, columns: int) -> Tensor:
    """[B, columns] uniform numbers in [0, 1), of each unit from its own generator."""
    return torch.cat([torch.rand(_count(part.rows), columns, generator=part.generator) for part in oracle.parts])


def _normal(part: tuple[slice, torch.Generator], observation: Tensor) -> Tensor:
    rows, generator = part
    return torch.randn(observation[rows, :, 1:].shape, generator=generator)


def _count(rows: slice) -> int:
    return rows.stop - rows.start


def _resolution(features: Features) -> Tensor:
    """[F - 1] resolution of the sensors on the normalised scale; a hundredth of the half range where the world says none."""
    half = features.half_range()
    return torch.tensor(features.floors) / half if features.floors else torch.full_like(half, 0.01)


def _shifted(observation: Tensor, shift: Tensor, oracle: Oracle) -> Tensor:
    """The observation with other values, in the perturbation set."""
    return oracle.project(
        observation + torch.cat((torch.zeros_like(observation[..., :1]), shift.expand_as(observation[..., 1:])), -1)
    )


def _placed(place: Tensor, observation: Tensor, features: Features) -> Tensor:
    """Rows of cars [B, K, F] at random places ahead, within two lanes, about as fast as the ego.

    `place` is [B, K, 4] in [0, 1).
    """
    low, high = torch.tensor((5.0, -6.0, -5.0, 0.0)), torch.tensor((60.0, 6.0, 5.0, 0.0))
    physical = low + place * (high - low)
    # Along the road, however the ego moves across it.
    physical[..., 3] = -features.physical(observation[:, 0])[:, features.names.index("vy"), None]
    return _rows(physical, features, observation)


def _moved(cars: Tensor, before: Tensor, ego: Tensor, oracle: Oracle) -> Tensor:
    """The cars [B, K, F] one decision later, at the same speeds on the road; the ego's row [B, F] before and now."""
    features = oracle.features
    at = [features.names.index(name) for name in NEEDED]
    physical, gained = features.physical(cars)[..., at], (features.physical(ego) - features.physical(before))[:, at]
    physical[..., :2] += oracle.period * (physical[..., 2:] - gained[:, None, 2:] / 2)
    physical[..., 2:] -= gained[:, None, 2:]
    return _rows(physical, features, cars)


def _rows(physical: Tensor, features: Features, like: Tensor) -> Tensor:
    """Rows [..., F] of cars with x, y, vx, vy in physical units; other features are 0."""
    at = [features.names.index(name) for name in NEEDED]
    values, rows = torch.zeros(2, *physical.shape[:-1], like.shape[-1])
    values[..., [1 + one for one in at]] = physical
    rows[..., [1 + one for one in at]] = features.normalised(values[..., 1:])[..., at]
    rows[..., 0] = 1.0
    return rows.clamp(-1.0, 1.0)
