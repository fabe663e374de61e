"""The leader brakes for no reason."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.attacks.driving.driven import (
    GENTLE,
    OVERTAKING,
    TrafficAttack,
    has_room,
    lane_centre,
    room,
    towards,
)
from cavbench.core.ranges import Count
from cavbench.driving.sets import Traffic
from cavbench.driving.traffic import View

REACH = 80.0
"""Cars farther ahead than this in m are not driven."""
WINDOW = 15.0
"""The car brakes if it is at most so much farther ahead than it must be, in m."""


@dataclass(frozen=True, kw_only=True)
class BrakeCheck(TrafficAttack):
    """Drives the car ahead of the victim, which brakes as hard as the threat model allows, and then drives on.

    After each braking the nearest car ahead is taken anew. It lets the victim come as near as a braking may begin, and changes to
    its lane where there is room. It shows the truth and asks the victim nothing.

    Distance: the set `traffic` of the threat model; it needs `threat.traffic.cars=1`.

    Args:
        held: frames for which it brakes, at least 1 (default 23, 1.5 s at 15 Hz).
        every: frames from one braking to the next, at least 1 (default 90).

    Shapes: observation [B, V, F] in, the same out. Queries: none.
    """

    joint: ClassVar[bool] = True
    fickle: ClassVar[bool] = True

    held: Count = 23
    every: Count = 90

    def wanted(self, view: View) -> Tensor:
        lane = lane_centre(view.y) == lane_centre(view.y[:, :1])
        return view.x.where(lane & (view.x > 0) & (view.x < REACH), torch.inf)

    def manoeuvre(self, view: View, bounds: Traffic, state: TensorDict) -> tuple[Tensor, Tensor]:
        car, ego = view.of_car(state["car"]), view.of_car(torch.zeros_like(state["car"]))
        needed, lane = room(ego.speed, bounds), lane_centre(ego.y)
        ahead = (car.x >= needed) & (ego.speed - car.speed <= bounds.closing)
        near = ahead & (car.x <= needed + WINDOW) & (lane_centre(car.y) == lane) & (car.speed > GENTLE)
        free = has_room(view, state["car"], lane, bounds)
        begun = near & (state["since"] >= self.every)
        state["since"] = torch.where(begun, 0, state["since"])
        state["left"] = torch.where(begun, self.held, state["left"])
        braking = state["left"] > 0
        speed = torch.where(
            car.x >= needed + WINDOW / 2, ego.speed - GENTLE, torch.where(ahead, ego.speed, ego.speed + OVERTAKING)
        )
        acceleration = torch.where(braking, -bounds.braking, towards(car.speed, speed, bounds))
        return acceleration, torch.where(ahead & free & ~braking, lane, lane_centre(car.y))
