"""Drivers that learn nothing: what any victim must beat to be worth attacking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from bench.driving.contracts import ActionType, Driver, DrivingVictim, Policy

LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER = range(5)
"""highway-env's discrete meta-actions."""

DISCRETE = {"lane_left": LANE_LEFT, "idle": IDLE, "lane_right": LANE_RIGHT, "faster": FASTER, "slower": SLOWER}
CONTINUOUS = {"throttle": (1.0, 0.0), "coast": (0.0, 0.0), "brake": (-1.0, 0.0)}


class _BlindPolicy(Policy):
    """The same action at every step, or LANE_RIGHT at the first `lane_changes` steps and SLOWER from then on."""

    def __init__(
        self, action: Tensor, action_type: ActionType, lane_changes: int = 0, driver: Driver = "agent"
    ) -> None:
        super().__init__()
        self.action, self.action_type, self.driver = action, action_type, driver
        self.lane_changes, self.steps = lane_changes, 0

    def reset(self, seeds: Tensor) -> None:
        self.steps = 0

    def scores(self, observation: Tensor) -> Tensor:
        action = torch.tensor(LANE_RIGHT) if self.steps < self.lane_changes else self.action
        if self.action_type == "discrete":
            action = torch.nn.functional.one_hot(action, 5).float()
        return action.expand(*observation.shape[:-2], action.shape[-1])

    def decide(self, observation: Tensor) -> Tensor:
        action = super().decide(observation)
        self.steps += 1
        return action


@dataclass(frozen=True, kw_only=True)
class Blind(DrivingVictim):
    """A driver that ignores what it sees: a constant action, or the rightmost lane and then the brake.

    The best of these in a cell is the bar under attack: a victim below it would do better with its eyes shut.

    Args:
        policy: the action; `throttle`, `coast` and `brake` are continuous, the rest discrete. `right_then_slower` changes
            to the right for as long as it takes from any lane, then slows down.
    """

    sees: ClassVar[bool] = False
    policy: Literal[
        "lane_left", "idle", "lane_right", "faster", "slower", "right_then_slower", "throttle", "coast", "brake"
    ] = "right_then_slower"

    @property
    def action_type(self) -> ActionType:
        return "continuous" if self.policy in CONTINUOUS else "discrete"

    def load(self, seed: int) -> Policy:
        if self.policy in CONTINUOUS:
            return _BlindPolicy(torch.tensor(CONTINUOUS[self.policy]), "continuous").eval()
        if self.policy == "right_then_slower":
            return _BlindPolicy(torch.tensor(SLOWER), "discrete", lane_changes=RIGHT_STEPS).eval()
        return _BlindPolicy(torch.tensor(DISCRETE[self.policy]), "discrete").eval()


RIGHT_STEPS = 60
"""Four seconds at 15 Hz: enough to cross four lanes at 25 m/s, one after the other."""


class _RandomPolicy(Policy):
    """Actions drawn from a generator of each episode's own, so that they depend on the scenario seed alone."""

    def __init__(self, action_type: ActionType) -> None:
        super().__init__()
        self.action_type = action_type
        self.draws = torch.empty(0)
        self.steps = 0

    def reset(self, seeds: Tensor) -> None:
        self.steps = 0
        self.draws = torch.stack(
            [torch.rand(1024, 5, generator=torch.Generator().manual_seed(int(seed))) for seed in seeds], 1
        )

    def scores(self, observation: Tensor) -> Tensor:
        draw = self.draws[self.steps % len(self.draws)]
        draw = draw if self.action_type == "discrete" else 2 * draw[:, :2] - 1
        return draw.expand(*observation.shape[:-2], draw.shape[-1])

    def decide(self, observation: Tensor) -> Tensor:
        action = super().decide(observation)
        self.steps += 1
        return action


@dataclass(frozen=True, kw_only=True)
class RandomDriver(DrivingVictim):
    """Uniformly random actions.

    Args:
        actions: discrete lane-changing decisions, or continuous acceleration and steering.
    """

    sees: ClassVar[bool] = False
    actions: Literal["discrete", "continuous"] = "discrete"

    @property
    def action_type(self) -> ActionType:
        return self.actions

    def load(self, seed: int) -> Policy:
        return _RandomPolicy(self.actions).eval()


@dataclass(frozen=True, kw_only=True)
class IDMDriver(DrivingVictim):
    """highway-env's own traffic driver at the wheel: IDM for speed, MOBIL for lanes (Treiber et al. 2000, Kesting et al. 2007).

    It reads the simulator's true state, not the observation, so that attacks and weather cannot touch it.
    """

    sees: ClassVar[bool] = False

    @property
    def action_type(self) -> ActionType:
        return "discrete"

    def load(self, seed: int) -> Policy:
        return _BlindPolicy(torch.tensor(IDLE), "discrete", driver="idm").eval()
