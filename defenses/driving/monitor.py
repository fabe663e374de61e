"""Intrusion detection: an alarm when what is shown does not fit how cars move, and another driver after it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import torch
from annotated_types import Interval
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.ranges import NotNegative, Positive
from cavbench.defenses.driving.tracker import Tracker
from cavbench.driving import DrivingDefense, DrivingFacts, DrivingVictim, Policy, PolicyWrapper, State, Suspicion
from cavbench.driving.intervals.boxes import Assumed
from cavbench.driving.intervals.consistency import Consistency
from cavbench.driving.intervals.ego import fields
from cavbench.driving.intervals.policy import reckoning, with_inner
from cavbench.driving.victims.planner import Planner
from cavbench.errors import UserError

Fallback = Literal["planner", "brake", "none"]


@dataclass(frozen=True, kw_only=True)
class Monitor(DrivingDefense):
    """Raises an alarm when measurements contradict how cars can move, and lets a fallback driver take over for a while.

    Every car is followed from frame to frame. Its position must change by the integral of its velocity, and its velocity by no
    more than a car can accelerate; none may appear out of nowhere ahead. The largest of these residuals, each divided by its
    limit, is the suspicion; from 1 on there is an alarm. The victim drives until then, on what is shown.

    Args:
        moved: largest difference between a shown way and the integral of the shown velocity, in m.
        jumped: largest sum of jumps of a velocity beyond what a car can accelerate, in m/s.
        fallback: who drives after an alarm. `planner`: rules on the worst case of `assumed_budget`, behind the tracker. `brake`:
            SLOWER. `none`: the victim goes on, and the alarm is only recorded.
        hold_s: how long the fallback drives after the last frame with an alarm, in s.
        assumed_budget: budget that the `planner` assumes.
    """

    reckons: ClassVar[bool] = True
    brakes_to: ClassVar[float | None] = 10.0

    moved: Positive = 2.25
    jumped: Positive = 3.0
    fallback: Fallback = "planner"
    hold_s: NotNegative = 10.0
    assumed_budget: Annotated[float, Interval(ge=0, le=0.9)] = 0.1

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        if not victim.sees:
            raise UserError("defense 'monitor' needs a victim that sees")
        if victim.action_type != "discrete" and self.fallback != "none":
            raise UserError(
                "the fallback drivers of defense 'monitor' take discrete actions, this victim's are continuous: "
                "use defense.fallback=none"
            )
        if facts.kinematics is not None and facts.kinematics.way is not None:
            raise UserError("defense 'monitor' needs straight parallel lanes: on this world's road they bend")
        planner = None
        if self.fallback == "planner":
            planner = Tracker(assumed_budget=self.assumed_budget).load(Planner(), seed, facts)
        return Monitored(self, victim.load(seed, facts), planner, facts).eval()


class Monitored(PolicyWrapper):
    """A policy that is watched. Its state is the followed cars, the reckoned ego, and the states of both drivers."""

    def __init__(self, settings: Monitor, policy: Policy, planner: Policy | None, facts: DrivingFacts) -> None:
        super().__init__(policy)
        self.settings, self.planner = settings, planner
        self.period = 1 / facts.decision_hz
        self.reckoning = reckoning(facts, policy.action_type)
        self.consistency = Consistency(facts.features, self.period)
        self.shown = Assumed(facts.features, "relative", 0.0)
        self.brakes = facts.actions.index("SLOWER") if settings.fallback == "brake" else -1

    def initial(self, episodes: Tensor) -> State:
        own = {"ego": self.reckoning.unknown(episodes), "left": torch.zeros(len(episodes), device=episodes.device)}
        if self.planner is not None:
            fallback = self.planner.initial(episodes)
            assert fallback is not None
            own["fallback"] = fallback
        return with_inner(own, self.policy.initial(episodes), episodes.shape)

    def suspicion(self, observation: Tensor, state: State) -> Suspicion:
        level = self._level(self._followed(observation, state))
        return Suspicion(level, level >= 1)

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        assert state is not None
        scores = self.policy.scores(observation, state.get("inner", None))
        if self.settings.fallback == "none":
            return scores
        taken_over = (state["left"] > 0) | (self._level(self._followed(observation, state)) >= 1)
        if self.planner is not None:
            other = self.planner.scores(observation, state["fallback"])
        else:
            other = torch.zeros_like(scores)
            other[..., self.brakes] = 1.0
        return torch.where(taken_over.unsqueeze(-1), other, scores)

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        assert state is not None
        return self.policy.value(observation, action, state.get("inner", None))

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        assert state is not None
        followed = self._followed(observation, state)
        ego = self.reckoning.now(self.shown.boxes(observation), state["ego"])
        left = torch.where(self._level(followed) >= 1, self.settings.hold_s, (state["left"] - self.period).clamp(min=0))
        own = {"ego": self.reckoning.after(ego, action), "cars": followed, "left": left}
        if self.planner is not None:
            fallback = self.planner.advance(observation, action, state["fallback"])
            assert fallback is not None
            own["fallback"] = fallback
        return with_inner(own, self.policy.advance(observation, action, state.get("inner", None)), state.batch_size)

    def _followed(self, observation: Tensor, state: State) -> TensorDict:
        """The followed cars with this observation."""
        assert state is not None
        cars = state.get("cars", None)
        measured = self.consistency.features.physical(observation)[:, 0, 2]
        ego, known = fields(state["ego"])
        reckoned = torch.where(known, ego.speed * ego.heading.cos(), measured)
        before = self.consistency.initial(observation) if cars is None else cars
        return self.consistency.step(observation, reckoned, before)

    def _level(self, cars: TensorDict) -> Tensor:
        """The suspicion [B]."""
        found, settings = self.consistency.residuals(cars), self.settings
        return torch.maximum(found.moved / settings.moved, found.jumped / settings.jumped)
