"""The car beside cuts in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.attacks.driving.driven import (
    LANE_WIDTH,
    OVERTAKING,
    TrafficAttack,
    has_room,
    lane_centre,
    room,
    towards,
)
from cavbench.core.ranges import Count, NotNegative
from cavbench.driving.sets import Traffic
from cavbench.driving.traffic import View

REACH = 60.0
"""Cars farther ahead than this in m are not driven."""
WINDOW = 8.0
"""The car cuts in if it is at most so much farther ahead than it must be, in m."""


@dataclass(frozen=True, kw_only=True)
class CutIn(TrafficAttack):
    """Drives a car of the next lane, which gets just ahead of the victim and changes into its lane, slower than the victim.

    The car overtakes or falls back until it is near. It changes lane as soon as the threat model allows it, and brakes. When
    the victim leaves the lane, it does so again. It shows the truth and asks the victim nothing. Cut-ins are the most
    frequent critical scenario of UN Regulation 157.

    Distance: the set `traffic` of the threat model; it needs `threat.traffic.cars=1`.

    Args:
        slower: how much slower than the victim the car is when it cuts in, in m/s, at least 0 (default 4).
        braking: how hard it brakes once it has changed lane, in m/s2, at least 0 (default 2); above 2 it needs room.
        held: frames for which it brakes, at least 1 (default 30).
        every: frames between two cut-ins, at least 1 (default 60).

    Shapes: observation [B, V, F] in, the same out. Queries: none.
    """

    joint: ClassVar[bool] = True

    slower: NotNegative = 4.0
    braking: NotNegative = 2.0
    held: Count = 30
    every: Count = 60

    def wanted(self, view: View) -> Tensor:
        aside = (lane_centre(view.y) - lane_centre(view.y[:, :1])).abs()
        use = (aside == LANE_WIDTH) & (view.x > -LANE_WIDTH) & (view.x < REACH)
        return (view.x - REACH / 3).abs().where(use, torch.inf)

    def manoeuvre(self, view: View, bounds: Traffic, state: TensorDict) -> tuple[Tensor, Tensor]:
        car, ego = view.of_car(state["car"]), view.of_car(torch.zeros_like(state["car"]))
        needed, slower = room(ego.speed, bounds), min(self.slower, bounds.closing)
        lane = lane_centre(ego.y)
        outside = lane_centre(car.y) != lane
        near = (car.x <= needed + WINDOW) & has_room(view, state["car"], lane, bounds)
        begun = outside & near & (car.x > 0) & (state["since"] >= self.every)
        state["since"] = torch.where(begun, 0, state["since"])
        state["left"] = torch.where(begun, self.held, state["left"])
        cutting = state["left"] > 0
        speed = torch.where(car.x >= needed, ego.speed - slower, ego.speed + OVERTAKING)
        acceleration = torch.where(cutting & ~begun, -self.braking, towards(car.speed, speed, bounds))
        return acceleration, torch.where(cutting, lane, lane_centre(car.y))
