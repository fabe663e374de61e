"""A driver by rules on intervals: it takes no decision that the worst case behind the shown values would make unsafe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval
from torch import Tensor

from bench.driving import ActionType, DrivingFacts, DrivingVictim, Policy, State
from bench.driving.intervals.boxes import Boxes
from bench.driving.intervals.margins import SIDES, Caution, Judge
from bench.driving.intervals.policy import IntervalPolicy
from bench.driving.threat import Norm
from bench.plugins.ranges import NotNegative, Share

FORBIDDEN = -10.0


@dataclass(frozen=True, kw_only=True)
class Planner(DrivingVictim):
    """Drives by rules on the interval of true values behind each shown value. It learns nothing.

    Args:
        assumed_budget: budget of the perturbation set that it assumes.
        assumed_norm: kind of this set.
        braking: deceleration of a leader that has another car ahead, in m/s2.
        braking_s: for how long it brakes, in s.
        distance: room that is always kept, in m.
        right: worth of being one lane further to the right.
        gain: how much better another lane must be.
    """

    assumed_budget: Annotated[float, Interval(ge=0, le=0.9)] = 0.1
    assumed_norm: Norm = "relative"
    braking: NotNegative = 0.5
    braking_s: NotNegative = 2.0
    distance: NotNegative = 0.4
    right: Share = 0.06
    gain: Share = 0.05
    horizon: NotNegative = 3.0
    second: NotNegative = 0.15

    @property
    def action_type(self) -> ActionType:
        return "discrete"

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return _Planner(self, facts).eval()


class _Planner(IntervalPolicy):
    def __init__(self, rules: Planner, facts: DrivingFacts) -> None:
        super().__init__(facts, "discrete", rules.assumed_norm, rules.assumed_budget)
        self.rules = rules
        caution = Caution(braking=rules.braking, seconds=rules.braking_s, distance=rules.distance)
        self.judge = Judge(self.reckoning, self.period, caution, rules.horizon)

    def initial(self, episodes: Tensor) -> State:
        return self.reckoning.unknown(episodes)

    def weighed(self, observation: Tensor, boxes: Boxes, state: State) -> Tensor:
        assert state is not None
        rules = self.rules
        ego = self.reckoning.now(boxes, state)
        found = self.judge(ego, boxes)
        low, high = 20.0, self.reckoning.kinematics.target_speeds[-1]
        right = torch.where(ego.edge < 64, 0.2 / ego.edge.clamp(min=1), rules.right).unsqueeze(-1)
        there = ego.target_lane.unsqueeze(-1) + torch.tensor(SIDES).to(ego.y)
        worth = 0.8 * (found.speed - low) / (high - low) + right * torch.tensor(SIDES).to(ego.y)
        worth = torch.where((there >= 0) & (there <= ego.edge.unsqueeze(-1)), worth, FORBIDDEN)
        away = rules.second * torch.arange(4.0)
        worth = torch.stack([(worth[..., [3, 2, 1, 0]] - away).amax(-1), worth[..., 4], (worth[..., 5:] - away).amax(-1)], -1)
        unsafe = found.stay * 0.02 - 2 - torch.tensor([0.04, 0.02, 0.0])
        stay = worth[..., 1:2] - torch.tensor([0.0, 0.02, 0.04])
        stay = torch.where(found.stay < 0, unsafe, stay + 1e-4 * found.stay)
        side = worth[..., [0, 2]] - rules.gain
        side = torch.where(found.change < 0, FORBIDDEN + 0.02 * found.change, side + 1e-4 * found.change)
        # Only back to the lane that it comes from, if this one is no longer safe.
        back = torch.stack([found.straddled < 0, found.straddled > 0], -1) & (found.stay[..., 2:] < 0)
        side = torch.where(found.settled.unsqueeze(-1) | back, side, FORBIDDEN)
        return torch.cat((stay, side), -1)[..., self.reckoning.order]

    def moved(self, observation: Tensor, boxes: Boxes, action: Tensor, state: State) -> State:
        assert state is not None
        return self.reckoning.after(self.reckoning.now(boxes, state), action)
