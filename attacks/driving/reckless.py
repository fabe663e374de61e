"""Searches for the manoeuvre of one car that hurts this victim most, with the victim in the loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.attacks.driving.driven import LANE_WIDTH, LENGTH, lane_centre, orders
from cavbench.core.contracts import Access
from cavbench.core.ranges import Count, Natural, NotNegative, Positive
from cavbench.driving import DrivingAttack, Oracle, State
from cavbench.driving.traffic import View

CANDIDATES = 4
"""So many cars are considered: the nearest ones ahead of the victim's rear bumper."""
REACH = 60.0
"""Cars farther ahead than this, in m, are not considered."""
SIDES = 3
"""It stays in its lane, or goes one lane to the left or to the right."""
NUMBERS = 3
"""Numbers of a plan: when the car changes lane (a share of the horizon), and its acceleration before and after, from 0 to 1."""
SMOOTHING = 0.3
"""So much of a distribution stays uniform in every round."""
SPREAD = 0.1
"""Least standard deviation of a number in a round."""


@dataclass(frozen=True, kw_only=True)
class Reckless(DrivingAttack):
    """Drives one car by plans that it finds by cross-entropy search (Rubinstein 1999) in simulations with a copy of the victim.

    White box with access `dynamics`. A plan says which of the nearest cars is driven, whether and when it changes lane, and how
    it accelerates or brakes before and after. As `rehearse` does, it computes a belief about the traffic from the true
    observations, simulates the next seconds with a copy of the victim and whatever defends it, and keeps the plan that costs the
    victim most. Plans are drawn uniformly in the first round, and in the next ones around the best ones of the round before. The
    plan that is being driven competes with them. It shows the truth. Compare Adaptive Stress Testing (Lee et al. 2020) and AdvSim
    (Wang et al. 2021).

    Distance: the set `traffic` of the threat model; it needs `threat.traffic.cars=1`.

    Args:
        horizon: length of a simulation in seconds, above 0 (default 2.6).
        renew: frames for which a plan is driven before the next search, at least 1 (default 10).
        plans: plans in a round, at least 2 (default 12).
        rounds: rounds of a search, at least 1 (default 2).
        elite: plans around which the next round is drawn, at least 1 (default 3).
        crash: what a crash is worth to the attack, in decisions of full progress (default 250).
        draw: number of the random draw: another number is the same attack with other random plans.

    Shapes: observation [B, V, F] in, the same out. Queries: plans * rounds for each simulated decision, in every `renew`-th step
    (936 by default). With a smaller query budget it looks less far ahead.

    Raises:
        UserError: if the world cannot be simulated step by step.
    """

    access: ClassVar[Access] = "dynamics"
    drives: ClassVar[bool] = True
    joint: ClassVar[bool] = True

    horizon: Positive = 2.6
    renew: Count = 10
    plans: Count = 12
    rounds: Count = 2
    elite: Count = 3
    crash: NotNegative = 250.0
    draw: Natural = 0

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        state = oracle.dynamics.unknown()
        batch = len(state)
        state["age"] = torch.zeros(batch, dtype=torch.int64)
        for name, value in _nothing(batch).items():
            state[name] = value
        return state

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor, State]:
        assert state is not None
        if not len(observation):
            return observation, state
        belief = oracle.dynamics.believe(observation, state)
        plan = {name: state[name].clone() for name in _nothing(1)}
        # All episodes of a step have the same age.
        if int(state["age"][0]) % self.renew == 0:
            plan = self._search(belief, plan, oracle)
        acceleration, y = course(plan, torch.zeros_like(state["age"]))
        oracle.order(orders(oracle.traffic, plan["car"], acceleration, y))
        # The time of the change comes nearer.
        plan["change"] = plan["change"] - 1
        for name, value in plan.items():
            belief[name] = value
        belief["age"] = state["age"] + 1
        return observation, belief

    def _search(self, belief: TensorDict, present: dict[str, Tensor], oracle: Oracle) -> dict[str, Tensor]:
        """The best plan of each episode; the present one if none is better."""
        horizon = max(1, round(self.horizon / oracle.dynamics.period))
        affordable = int(oracle.remaining.min()) * oracle.draws // (self.plans * self.rounds)
        decisions = min(horizon, affordable)
        if decisions < 1:
            return present
        cars, there = candidates(oracle.traffic)
        batch = len(cars)
        chance = {
            "which": there / there.sum(-1, keepdim=True).clamp(min=1),
            "side": torch.full((batch, SIDES), 1 / SIDES),
        }
        mean, deviation = torch.zeros(0), torch.zeros(0)
        best = present
        for number in range(self.rounds):
            drawn = self._drawn(chance, mean, deviation, oracle)
            plans = _plans(drawn, cars, decisions, oracle)
            for name, value in plans.items():
                # The first plan is the best one so far.
                value[0] = best[name]
            worth = self._worth(belief, plans, decisions, oracle)
            first = worth.argmin(0)
            best = {name: value.gather(0, first[None]).squeeze(0) for name, value in plans.items()}
            if number + 1 < self.rounds:
                elite = worth[1:].argsort(0)[: self.elite] + 1
                chance, mean, deviation = _around(drawn, elite, chance)
        return best

    def _drawn(self, chance: dict[str, Tensor], mean: Tensor, deviation: Tensor, oracle: Oracle) -> dict[str, Tensor]:
        """Random plans: `which` and `side` int64 [K, B], `numbers` [K, B, NUMBERS] in [0, 1]."""
        batch, found = len(oracle.observation), {}
        for name, share in chance.items():
            found[name] = torch.zeros(self.plans, batch, dtype=torch.int64)
            for part in oracle.parts:
                some = share[part.rows] + 1e-9
                found[name][:, part.rows] = torch.multinomial(some, self.plans, True, generator=part.generator).T
        numbers = torch.zeros(self.plans, batch, NUMBERS)
        for part in oracle.parts:
            shape = numbers[:, part.rows].shape
            if len(mean):
                normal = torch.randn(shape, generator=part.generator)
                numbers[:, part.rows] = (mean[part.rows] + deviation[part.rows] * normal).clamp(0, 1)
            else:
                numbers[:, part.rows] = torch.rand(shape, generator=part.generator)
        return found | {"numbers": numbers}

    def _worth(self, belief: TensorDict, plans: dict[str, Tensor], decisions: int, oracle: Oracle) -> Tensor:
        """[K, B] the progress of the victim under each plan, less the worth of a crash."""
        view = oracle.traffic
        world, victim = oracle.dynamics.rehearsal(belief, self.plans), oracle.imagined(self.plans)
        worth = torch.zeros(plans["car"].shape)
        for step in range(decisions):
            action, victim = oracle.rehearse(world.observation.to(oracle.observation), victim)
            acceleration, y = course(plans, torch.full_like(plans["car"], step))
            given = [orders(view, *one).stacked() for one in zip(plans["car"], acceleration, y, strict=True)]
            world.order(torch.stack(given), view, oracle.threat.traffic)
            world.step(action)
            worth += world.progress
        return worth - self.crash * world.failed


def _nothing(batch: int) -> dict[str, Tensor]:
    """A plan that drives no car: its number, frames until the change, places across the road and accelerations, [B] each."""
    whole, zero = torch.zeros(batch, dtype=torch.int64), torch.zeros(batch, dtype=torch.float64)
    return {"car": whole, "change": whole.clone()} | {
        name: zero.clone() for name in ("from_y", "to_y", "before", "after")
    }


def course(plan: dict[str, Tensor], step: Tensor) -> tuple[Tensor, Tensor]:
    """The acceleration and the place across the road in a plan, so many decisions from now."""
    later = step >= plan["change"]
    return plan["after"].where(later, plan["before"]), plan["to_y"].where(later, plan["from_y"])


def candidates(view: View) -> tuple[Tensor, Tensor]:
    """The numbers of the nearest cars [B, CANDIDATES] int64, and whether there are so many."""
    use = (view.x > -LENGTH) & (view.x < REACH) & (view.crashed == 0)
    use[:, 0] = False
    cost, order = (view.x.abs() + (view.y - view.y[:, :1]).abs()).where(use, torch.inf).sort(1)
    return order[:, :CANDIDATES], cost[:, :CANDIDATES].isfinite().double()


def _plans(drawn: dict[str, Tensor], cars: Tensor, decisions: int, oracle: Oracle) -> dict[str, Tensor]:
    """The plans [K, B] that random numbers stand for."""
    view, bounds = oracle.traffic, oracle.threat.traffic
    car = cars[torch.arange(len(cars)), drawn["which"]]
    numbers = drawn["numbers"].double()
    lane = lane_centre(torch.stack([view.of_car(one).y for one in car]))
    span = bounds.acceleration + bounds.braking
    return {
        "car": car,
        "change": (numbers[..., 0] * decisions).long(),
        "from_y": lane,
        "to_y": lane + LANE_WIDTH * (drawn["side"] - 1),
        "before": numbers[..., 1] * span - bounds.braking,
        "after": numbers[..., 2] * span - bounds.braking,
    }


def _around(
    drawn: dict[str, Tensor], elite: Tensor, chance: dict[str, Tensor]
) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """The distribution of the next round, from the best plans `elite` [E, B] of this one."""
    found = {}
    for name, share in chance.items():
        chosen = drawn[name].gather(0, elite)
        often = torch.stack([(chosen == value).double().mean(0) for value in range(share.shape[1])], 1)
        found[name] = (1 - SMOOTHING) * often + SMOOTHING * share
    numbers = drawn["numbers"].gather(0, elite[..., None].expand(-1, -1, NUMBERS))
    return found, numbers.mean(0), numbers.std(0, correction=0).clamp(min=SPREAD)
