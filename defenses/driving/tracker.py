"""A state estimator in front of a driver: the set of states that all observations so far allow for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from annotated_types import Interval
from torch import Tensor

from cavbench.core.ranges import NotNegative
from cavbench.driving import DrivingDefense, DrivingFacts, DrivingVictim, Passed, Policy, PolicyWrapper, State
from cavbench.driving.intervals.boxes import Assumed, Boxes
from cavbench.driving.intervals.policy import IntervalPolicy, reckoning, remembers, with_inner
from cavbench.driving.intervals.tracks import predicted
from cavbench.driving.threat import Norm


@dataclass(frozen=True, kw_only=True)
class Tracker(DrivingDefense):
    """Intersects the intervals of every car over time (set-membership estimation, Schweppe 1968).

    The interval of true values behind each shown value is intersected with the one predicted from the observation before: a car
    accelerates by at most 6 m/s2. A policy that acts on intervals (`planner`, `shield`) receives the intersection; any other
    one receives its middle. The ego's own row is reckoned from its actions. This removes what an attack gains by changing from
    frame to frame, and nothing of a constant scaling.

    Args:
        assumed_budget: budget of the perturbation set that it assumes.
        assumed_norm: kind of this set.
        assumed_noise: by how much the sensor may be wrong about other cars along the road besides, in m and m/s.
    """

    reckons: ClassVar[bool] = True

    assumed_budget: Annotated[float, Interval(ge=0, le=0.9)] = 0.1
    assumed_norm: Norm = "relative"
    assumed_noise: NotNegative = 0.1

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        return Tracked(self, victim.load(seed, facts), facts).eval()


class Tracked(PolicyWrapper):
    """A policy behind the estimator. Its state is the reckoned ego, the predicted boxes and the inner policy's state."""

    def __init__(self, settings: Tracker, policy: Policy, facts: DrivingFacts) -> None:
        super().__init__(policy)
        self.assumed = Assumed(facts.features, settings.assumed_norm, settings.assumed_budget, settings.assumed_noise)
        self.period = 1 / facts.decision_hz
        self.reckoning = reckoning(facts, policy.action_type)

    def initial(self, episodes: Tensor) -> State:
        own = {"ego": self.reckoning.unknown(episodes)}
        return with_inner(own, self.policy.initial(episodes), episodes.shape)

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        assert state is not None
        inner = state.get("inner", None)
        if not isinstance(self.policy, IntervalPolicy):
            return self.policy.scores(self._estimate(observation, self.boxes(observation, state), state), inner)
        if type(self).boxes is not Tracked.boxes:
            return self.policy.weighed(observation, self.boxes(observation, state), inner)
        return self.policy.answered(observation, self.assumed, state.get("tracks", None), inner)

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        assert state is not None
        estimate = self._estimate(observation, self.boxes(observation, state), state)
        return self.policy.value(estimate, action, state.get("inner", None))

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        assert state is not None
        boxes, inner = self.boxes(observation, state), state.get("inner", None)
        # One car, one motion: a policy on intervals does not reckon it again.
        step = self.reckoning.step(boxes, state["ego"], action)
        if isinstance(self.policy, IntervalPolicy):
            inner = self.policy.moved(observation, boxes, step, action, inner)
        elif remembers(self.policy):
            inner = self.policy.advance(self._estimate(observation, boxes, state), action, inner)
        tracks = predicted(boxes, *step, self.reckoning.kinematics, self.period)
        return with_inner({"ego": step.after, "tracks": tracks}, inner, state.batch_size)

    def passed(self, observation: Tensor, state: State = None) -> Passed:
        assert state is not None
        boxes, inner = self.boxes(observation, state), state.get("inner", None)
        if isinstance(self.policy, IntervalPolicy):
            return self.policy.filtered(observation, boxes, inner)
        return self.policy.passed(self._estimate(observation, boxes, state), inner)

    def assured(self, observation: Tensor, state: State) -> Tensor | None:
        assert state is not None
        if not isinstance(self.policy, IntervalPolicy):
            return None
        return self.policy.safe(self.boxes(observation, state), state.get("inner", None))

    def boxes(self, observation: Tensor, state: State) -> Boxes:
        """What is known about every row, from this observation [..., V, F] and those before."""
        assert state is not None
        return self.reckoning.boxes(self.assumed, observation, state["ego"], state.get("tracks", None))

    def _estimate(self, observation: Tensor, boxes: Boxes, state: State) -> Tensor:
        """The observation [..., V, F] with the middles of the boxes and the reckoned ego."""
        assert state is not None
        middle = self.assumed.normalised(self.reckoning.middles(boxes, observation.shape[-2]))
        present = observation[..., :1] > 0
        measured = torch.where(middle.isfinite() & present, middle, observation[..., 1:])
        estimate = torch.cat((observation[..., :1], measured), -1)
        return self.reckoning.corrected(estimate, self.reckoning.now(boxes, state["ego"]), boxes, self.assumed)
