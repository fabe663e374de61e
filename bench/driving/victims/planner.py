"""A driver by rules on intervals: it takes no decision that the worst case behind the shown values makes unsafe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
import torch
from annotated_types import Interval
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.ranges import NotNegative, Share
from cavbench.driving import ActionType, DrivingFacts, DrivingVictim, Policy, State
from cavbench.driving.intervals.boxes import Boxes
from cavbench.driving.intervals.ego import UNKNOWN_EDGE, Ego, Step
from cavbench.driving.intervals.kernels import SIDES
from cavbench.driving.intervals.margins import Judge
from cavbench.driving.intervals.policy import IntervalPolicy
from cavbench.driving.intervals.rooms import Caution, cars_of
from cavbench.driving.intervals.worth import Worth
from cavbench.driving.intervals.worth_kernels import Worths
from cavbench.driving.threat import Norm

FORBIDDEN, UNSAFE = -10.0, -2.0
"""Values of what is never done, and of what is done only if nothing is safe."""
LANE, SPEED = 0.2, 0.8
"""Shares of the rightmost lane and of the speed in the progress (thesis, Eq. 4.1)."""
SLOWEST = 20.0
"""The speed in m/s at which the progress begins."""
PER_METRE, TIE_BREAK = 0.02, 1e-4
"""Value of a metre of margin where nothing is safe, and elsewhere."""
ORDER = (0.0, -0.02, -0.04)
"""Small differences in value that order FASTER, IDLE and SLOWER; where nothing is safe, of the margin, the other way round."""


@dataclass(frozen=True, kw_only=True)
class Planner(DrivingVictim):
    """Drives by rules on the interval of true values behind each shown value. It learns nothing.

    Its own motion is reckoned from its actions. It drives as fast as it can brake in time for every car that may be ahead,
    changes to a lane that allows for more progress where the worst case leaves room, and changes back if that room is gone.

    Args:
        assumed_budget: budget of the perturbation set that it assumes.
        assumed_norm: kind of this set.
        assumed_noise: by how much the sensor may be wrong about other cars along the road besides, in m and m/s.
        braking: least deceleration that is assumed of a car ahead, in m/s2; it is higher where another car is close ahead of it.
        braking_s: how long a car ahead is assumed to brake, in s.
        distance: room between two cars that is always kept, in m.
        right: worth of a lane further to the right as long as the number of lanes is not known, in progress.
        gain: progress by which another lane must be better.
        detour: progress that a lane loses for every lane between it and the next one.
    """

    brakes_to: ClassVar[float | None] = 10.0

    assumed_budget: Annotated[float, Interval(ge=0, le=0.9)] = 0.1
    assumed_norm: Norm = "relative"
    assumed_noise: NotNegative = 0.05
    braking: NotNegative = 0.5
    braking_s: NotNegative = 2.0
    distance: NotNegative = 0.4
    right: Share = 0.06
    gain: Share = 0.05
    detour: Share = 0.15

    @property
    def action_type(self) -> ActionType:
        return "discrete"

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return IntervalPlanner(self, facts).eval()


class IntervalPlanner(IntervalPolicy):
    """The policy. Its scores are the progress that an action is worth, with a gradient to every shown value that matters."""

    def __init__(self, rules: Planner, facts: DrivingFacts) -> None:
        super().__init__(facts, "discrete", rules.assumed_norm, rules.assumed_budget, rules.assumed_noise)
        self.rules = rules
        caution = Caution(braking=rules.braking, seconds=rules.braking_s, distance=rules.distance)
        self.judge = Judge(self.reckoning, self.period, caution)
        self.compiled = Worth(self.judge, facts.features, self._values())

    def initial(self, episodes: Tensor) -> State:
        return TensorDict({"ego": self.reckoning.unknown(episodes)}, batch_size=episodes.shape)

    def weighed(self, observation: Tensor, boxes: Boxes, state: State) -> Tensor:
        assert state is not None
        if self.compiled.fits(observation, state):
            return self.compiled(boxes, state["ego"])[0]
        ego = self.reckoning.now(boxes, state["ego"])
        cars = cars_of(ego, boxes, self.reckoning.kinematics)
        found = self.judge(ego, cars)
        left, own, right = self._worth(ego, self.judge.rooms.speeds(ego, cars)).unbind(-1)
        order = torch.tensor(ORDER).to(own)
        safe = own.unsqueeze(-1) + order + TIE_BREAK * found.stay
        stay = torch.where(found.stay < 0, UNSAFE + PER_METRE * (found.stay - order), safe)
        change = found.worth_changing
        side = torch.stack([left, right], -1) - self.rules.gain + TIE_BREAK * change
        side = torch.where(change < 0, FORBIDDEN + PER_METRE * change, side)
        side = torch.where(found.changeable, side, FORBIDDEN)
        return torch.cat((stay, side), -1)[..., self.reckoning.order]

    def safe(self, boxes: Boxes, state: State) -> Tensor:
        assert state is not None
        if self.compiled.fits(boxes.low, state):
            return self.compiled(boxes, state["ego"])[1]
        ego = self.reckoning.now(boxes, state["ego"])
        return self.judge(ego, cars_of(ego, boxes, self.reckoning.kinematics)).safe

    def moved(self, observation: Tensor, boxes: Boxes, step: Step, action: Tensor, state: State) -> State:
        assert state is not None
        return TensorDict({"ego": step.after}, batch_size=state.batch_size)

    def _values(self) -> Worths:
        """The constants as the compiled loops take them."""
        rules = self.rules
        single = {
            "forbidden": FORBIDDEN,
            "unsafe": UNSAFE,
            "lane": LANE,
            "speed": SPEED,
            "slowest": SLOWEST,
            "span": self.reckoning.kinematics.target_speeds[-1] - SLOWEST,
            "per_metre": PER_METRE,
            "tie_break": TIE_BREAK,
            "right": rules.right,
            "gain": rules.gain,
            "detour": rules.detour,
        }
        return Worths(order=np.array(ORDER, np.float32), **{name: np.float32(value) for name, value in single.items()})

    def _worth(self, ego: Ego, speed: Tensor) -> Tensor:
        """[..., 3] the progress on the left, own and right lane, or on a lane beyond it less the detour."""
        top = self.reckoning.kinematics.target_speeds[-1]
        per_lane = torch.where(ego.edge < UNKNOWN_EDGE, LANE / ego.edge.clamp(min=1), self.rules.right).unsqueeze(-1)
        sides = torch.tensor(SIDES).to(speed)
        worth = SPEED * (speed - SLOWEST) / (top - SLOWEST) + per_lane * sides
        lane = ego.target_lane.unsqueeze(-1) + sides
        worth = torch.where((lane >= 0) & (lane <= ego.edge.unsqueeze(-1)), worth, FORBIDDEN)
        beyond = self.rules.detour * torch.arange(4.0).to(speed)
        left, right = worth[..., :4].flip(-1) - beyond, worth[..., 5:] - beyond
        return torch.stack([left.amax(-1), worth[..., 4], right.amax(-1)], -1)
