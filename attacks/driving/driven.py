"""What the attacks that drive cars of the traffic share: which car, and how it gets to its place beside the victim."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.driving import DrivingAttack, Oracle, State
from cavbench.driving.sets import Traffic
from cavbench.driving.traffic import Orders, View

LANE_WIDTH, LENGTH, WIDTH = 4.0, 5.0, 2.0
"""m, of the highway and of a car."""
BESIDE = 2.3
"""Cars are beside each other if less than this is between their centres across the road, in m."""
SPARE = 1.0
"""A driven car keeps so much more room than it needs at the beginning of a manoeuvre, in m."""
LOST = 15.0
"""A car so far behind the victim, in m, is given up for another one."""
SPEED_GAIN = 1.5
"""m/s2 for each m/s that a car is too slow."""
GENTLE = 2.0
"""Braking in m/s2 that is no manoeuvre (`cavbench.driving.sets.Traffic`)."""
OVERTAKING = 4.0
"""A car that must get ahead of the victim is so much faster, in m/s."""
LONG_AGO = 10_000
"""Frames since the last manoeuvre of a car that has made none."""
TOP_SPEED = 34.0
"""m/s, above which a driven car does not accelerate."""


@dataclass(frozen=True, kw_only=True)
class TrafficAttack(DrivingAttack):
    """An attack that drives one car by rule, and shows the truth.

    It keeps a car until it crashes or falls `LOST` behind, and then takes another one. Its state has the number of the car (0 for
    none), the frames since the last manoeuvre, and the frames that are left of it.
    """

    access: ClassVar[Access] = "oblivious"
    drives: ClassVar[bool] = True
    fickle: ClassVar[bool] = False
    """Whether it takes the most suitable car anew after each manoeuvre."""

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        batch = len(observation)
        zero = torch.zeros(batch, dtype=torch.int64)
        return TensorDict({"car": zero, "since": zero + LONG_AGO, "left": zero.clone()}, batch_size=[batch])

    def wanted(self, view: View) -> Tensor:
        """[B, N] how unsuitable a car is for the attack, in m; inf if it is of no use."""
        raise NotImplementedError

    def manoeuvre(self, view: View, bounds: Traffic, state: TensorDict) -> tuple[Tensor, Tensor]:
        """The acceleration [B] and the place across the road [B] of the car `state["car"]`; it updates the state."""
        raise NotImplementedError

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor, State]:
        assert isinstance(state, TensorDict)
        if not len(observation):
            return observation, state
        view, state = oracle.traffic, state.clone()
        self._choose(view, state)
        acceleration, y = self.manoeuvre(view, oracle.threat.traffic, state)
        oracle.order(orders(view, state["car"], acceleration, y))
        return observation, state

    def _choose(self, view: View, state: TensorDict) -> None:
        """Take a car where there is none, or where it was lost."""
        car = view.of_car(state["car"])
        lost = (state["car"] == 0) | (car.crashed > 0) | (car.x < -LOST)
        lost |= (state["left"] <= 1) & self.fickle
        cost, best = self.wanted(view).masked_fill(view.crashed > 0, torch.inf)[:, 1:].min(1)
        found = torch.where(cost.isfinite(), best + 1, 0)
        found = torch.where(found > 0, found, state["car"] * (car.crashed == 0))
        state["car"] = torch.where(lost, found, state["car"])
        state["left"] = torch.where(lost, 0, (state["left"] - 1).clamp(min=0))
        state["since"] = state["since"] + 1


def orders(view: View, car: Tensor, acceleration: Tensor, y: Tensor) -> Orders:
    """Orders to one car of each episode [B]; none where its number is 0."""
    given = Orders.none(view)
    column = car[:, None]
    given.driven.scatter_(1, column, column > 0)
    given.acceleration.scatter_(1, column, acceleration[:, None])
    given.y.scatter_(1, column, y[:, None])
    return given


def lane_centre(y: Tensor) -> Tensor:
    """The centre of the lane at a place across the road, in m."""
    return LANE_WIDTH * (y / LANE_WIDTH).round()


def room(speed: Tensor, bounds: Traffic) -> Tensor:
    """Distance between the centres of two cars, in m, from which a manoeuvre may begin ahead of a car with this speed in m/s."""
    return LENGTH + bounds.gap + bounds.headway * speed.clamp(min=0) + SPARE


def has_room(view: View, number: Tensor, y: Tensor, bounds: Traffic) -> Tensor:
    """Whether a car may begin to change to the place `y` across the road, bool [B]; as the world decides it."""
    car = View(*(values[:, None] for values in view.of_car(number)))
    new = ((view.y - y[:, None]).abs() < BESIDE) & ((view.y - car.y).abs() >= WIDTH)
    ahead = view.x >= car.x
    rear = torch.where(ahead, car.speed, view.speed)
    front = torch.where(ahead, view.speed, car.speed)
    gap = (view.x - car.x).abs() - LENGTH
    free = (gap >= bounds.gap + bounds.headway * rear.clamp(min=0)) & (rear - front <= bounds.closing)
    return (free | ~new).all(1)


def towards(speed: Tensor, wanted: Tensor, bounds: Traffic) -> Tensor:
    """The acceleration in m/s2 from a speed to the wanted one, in m/s, without a manoeuvre."""
    return (SPEED_GAIN * (wanted.clamp(max=TOP_SPEED) - speed)).clamp(-GENTLE, bounds.acceleration)
