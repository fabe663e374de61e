"""Cars around the victim hold it up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.attacks.driving.driven import (
    LANE_WIDTH,
    OVERTAKING,
    has_room,
    lane_centre,
    orders,
    room,
    towards,
)
from cavbench.core.contracts import Access
from cavbench.core.ranges import NotNegative
from cavbench.driving import DrivingAttack, Oracle, State
from cavbench.driving.traffic import Orders, View

PLACES = ((0.0, 1.0), (-LANE_WIDTH, 0.0), (LANE_WIDTH, 0.0))
"""Where the cars drive: across the road from the victim, in m, and whether ahead of it rather than beside it."""
REACH = 50.0
"""Cars farther away than this along the road, in m, are not driven."""
NEARING = 0.3
"""A car beside is so much faster, in m/s, for each m that it is behind its place."""


@dataclass(frozen=True, kw_only=True)
class BoxIn(DrivingAttack):
    """Drives up to three cars: one ahead of the victim that slows down, and one on each side of it that keeps level with it.

    With one car it drives the one ahead, with two also the one on the left. A car changes lane only while there is room for it.
    It shows the truth and asks the victim nothing.

    Distance: the set `traffic` of the threat model; `threat.traffic.cars` says how many cars it drives.

    Args:
        slowest: speed in m/s to which the car ahead slows down, at least 0 (default 12); for a slower victim it slows down more.

    Shapes: observation [B, V, F] in, the same out. Queries: none.
    """

    access: ClassVar[Access] = "oblivious"
    drives: ClassVar[bool] = True
    joint: ClassVar[bool] = True

    slowest: NotNegative = 12.0

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        cars = torch.zeros(len(observation), min(len(PLACES), oracle.threat.traffic.cars), dtype=torch.int64)
        return TensorDict({"cars": cars}, batch_size=[len(observation)])

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor, State]:
        assert isinstance(state, TensorDict)
        if not len(observation):
            return observation, state
        view, bounds, cars = oracle.traffic, oracle.threat.traffic, state["cars"].clone()
        ego, lane = view.of_car(torch.zeros_like(cars[:, 0])), lane_centre(view.y[:, 0])
        given = Orders.none(view)
        for role, (side, ahead) in enumerate(PLACES[: cars.shape[1]]):
            lost = view.of_car(cars[:, role]).x.abs() > REACH
            cars[:, role] = torch.where(lost, 0, cars[:, role])
            cars[:, role] = torch.where(cars[:, role] > 0, cars[:, role], self._nearest(view, lane + side, ahead, cars))
            car = view.of_car(cars[:, role])
            place = ahead * room(ego.speed, bounds)
            level = ego.speed + (NEARING * (place - car.x)).clamp(-OVERTAKING, OVERTAKING)
            slow = torch.where(car.x >= place, level.clamp(max=self.slowest), level) if ahead else level
            # The world asks for room when a manoeuvre begins; the victim may have come beside the car since.
            free = has_room(view, cars[:, role], lane + side, bounds)
            y = torch.where(free, lane + side, lane_centre(car.y))
            one = orders(view, cars[:, role], towards(car.speed, slow, bounds), y)
            given = given.joined(one)
        oracle.order(given)
        return observation, TensorDict({"cars": cars}, batch_size=state.batch_size)

    def _nearest(self, view: View, lane: Tensor, ahead: float, taken: Tensor) -> Tensor:
        """The number [B] of the nearest car on a lane, ahead of the victim or beside it, that has no place yet; 0 if none."""
        use = (lane_centre(view.y) == lane[:, None]) & (view.crashed == 0) & (view.x.abs() < REACH)
        use &= (view.x > 0) if ahead else torch.ones_like(use)
        use[:, 0] = False
        use.scatter_(1, taken, False)
        cost, best = view.x.abs().where(use, torch.inf).min(1)
        return torch.where(cost.isfinite(), best, 0)
