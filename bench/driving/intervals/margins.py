"""How much room each action leaves in the worst case of the intervals, in m."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from bench.driving.intervals.boxes import Boxes
from bench.driving.intervals.ego import DeadReckoning, Ego
from bench.driving.intervals.following import HARDEST, FollowingDistance
from bench.driving.kinematics import Kinematics

FREE = 200.0
"""The margin where there is no car, in m."""
CROSSING_S = 0.8
"""Time in which the ego leaves a lane."""
STRADDLING = 1.4
"""The ego is still in the lane that it comes from while it is this far from the middle of its target lane, in m."""
SETTLED_M, SETTLED_RAD = 0.5, 0.1
"""The ego is in its target lane if it is this close to the middle and to its direction."""
DRIFT_S, DEAD_BAND = 0.6, 0.5
"""A car may be as far to the side as it gets in this time in s with the part of its lateral speed above this, in m/s."""
CLEARANCE = 0.4
"""Lateral room between two cars, in m, below which they are in the same lane."""
REAR_S, REAR_BRAKING = 0.14, 4.0
"""A car behind reacts after this time in s, and brakes at this rate in m/s2."""
ROOM, HORIZON_S = 12.0, 3.0
"""Room to a car ahead that does not count as free, in m, and the time in which the free room counts as speed."""
SIDES = (-4, -3, -2, -1, 0, 1, 2, 3, 4)
"""The lanes in question, relative to the ego's target lane."""
BESIDE = (-1, 0, 1)
"""The lanes on the left, own and right."""


@dataclass(frozen=True, kw_only=True)
class Caution:
    """What is assumed of other cars.

    Args:
        braking: least rate at which a car ahead may brake, in m/s2; it is higher where another car is close ahead of it.
        seconds: how long a car ahead may brake.
        distance: room between two cars that is always kept, in m.
    """

    braking: float
    seconds: float
    distance: float


class Margins(NamedTuple):
    """Room in the worst case, in m; an action is safe if its margin is at least 0.

    Args:
        stay: of FASTER, IDLE and SLOWER, [..., 3].
        change: of LANE_LEFT and LANE_RIGHT, [..., 2].
        settled: bool [...], whether the ego is in its target lane.
        straddled: -1 or 1, the side of the lane that the ego is leaving, 0 if there is none, [...].
    """

    stay: Tensor
    change: Tensor
    settled: Tensor
    straddled: Tensor

    @property
    def safe(self) -> Tensor:
        """bool [...], whether any action is."""
        return (self.stay >= 0).any(-1) | ((self.change >= 0) & self.changeable).any(-1)

    @property
    def changeable(self) -> Tensor:
        """bool [..., 2]: from a lane the ego may go to both sides, and from between two back, if the new one is not safe."""
        back = torch.stack([self.straddled < 0, self.straddled > 0], -1) & (self.stay[..., 2:] < 0)
        return self.settled.unsqueeze(-1) | back


class Cars(NamedTuple):
    """The other cars, bounds in the road's frame, [..., V - 1] each: x relative to the ego, y, and the velocity."""

    present: Tensor
    x: tuple[Tensor, Tensor]
    y: tuple[Tensor, Tensor]
    vx: tuple[Tensor, Tensor]
    vy: tuple[Tensor, Tensor]

    @property
    def ahead(self) -> Tensor:
        return (self.x[0] + self.x[1]) > 0


class Judge:
    """Computes margins.

    Args:
        reckoning: the ego's kinematics.
        period: seconds per decision.
        caution: what is assumed of other cars.
    """

    def __init__(self, reckoning: DeadReckoning, period: float, caution: Caution) -> None:
        self.reckoning, self.period, self.caution = reckoning, period, caution
        car = reckoning.kinematics
        self.following = FollowingDistance(car, period, caution.seconds, within=(None, CROSSING_S))

    def __call__(self, ego: Ego, cars: Cars) -> Margins:
        car, reckoning = self.reckoning.kinematics, self.reckoning
        beside, ahead = lanes_of(ego, cars, car, BESIDE), cars.ahead.unsqueeze(-1)
        options = torch.stack([reckoning.commanded(ego, change) for change in (1, 0, -1)], -1)
        own = reckoning.speed_after(ego.speed.unsqueeze(-1), options).unsqueeze(-2)
        along = (ego.speed * ego.heading.cos()).unsqueeze(-1)
        leader = cars.vx[0].clamp(min=0)
        rate = braking_of(cars, car, self.caution.braking).unsqueeze(-1)
        gap = (cars.x[0] + (leader - along) * self.period - car.length - self.caution.distance).unsqueeze(-1)
        used = torch.cat(self.following(own, leader.unsqueeze(-1), rate), -1)
        front, cross = least(gap - used, beside & ahead).split(3, -1)
        room = room_behind(cars, own[..., 1], car.length + self.caution.distance)
        rear = least(room.unsqueeze(-1), beside & ~ahead)[..., 0]

        off = ego.y - car.lane_width * ego.target_lane
        straddled = torch.where(off.abs() > STRADDLING, off.sign(), 0.0)
        side = straddled.unsqueeze(-1)
        leaving = torch.where(side == 0, FREE, torch.where(side < 0, cross[..., 0, :], cross[..., 2, :]))
        change = torch.minimum(front[..., [0, 2], 1], rear[..., [0, 2]])
        change = torch.minimum(change, cross[..., 1:2, 1])
        exists = torch.stack([ego.target_lane > 0, ego.target_lane < ego.edge], -1)
        return Margins(
            stay=torch.minimum(front[..., 1, :], leaving),
            change=torch.where(exists, change, -FREE),
            settled=(off.abs() < SETTLED_M) & (ego.heading.abs() < SETTLED_RAD),
            straddled=straddled,
        )

    def speeds(self, ego: Ego, cars: Cars) -> Tensor:
        """[..., 9] the speed in m/s that each of the lanes `SIDES` allows for: the cars', and the free room over the horizon."""
        car = self.reckoning.kinematics
        counts = lanes_of(ego, cars, car, SIDES) & cars.ahead.unsqueeze(-1)
        allowed = _middle(*cars.vx) + (_middle(*cars.x) - ROOM).clamp(min=0) / HORIZON_S
        return torch.where(counts, allowed.unsqueeze(-1), FREE).amin(-2).clamp(max=car.target_speeds[-1])


@torch.no_grad()
def lanes_of(ego: Ego, cars: Cars, car: Kinematics, sides: tuple[int, ...]) -> Tensor:
    """bool [..., V - 1, S]: the lanes that each car may be in, or soon enter; `sides` are relative to the ego's target lane."""
    left = cars.y[0] + (cars.vy[0] + DEAD_BAND).clamp(max=0) * DRIFT_S
    right = cars.y[1] + (cars.vy[1] - DEAD_BAND).clamp(min=0) * DRIFT_S
    middle = car.lane_width * (ego.target_lane.unsqueeze(-1) + torch.tensor(sides).to(ego.y)).unsqueeze(-2)
    reach = car.width + CLEARANCE
    inside = (right.unsqueeze(-1) > middle - reach) & (left.unsqueeze(-1) < middle + reach)
    return inside & cars.present.unsqueeze(-1)


@torch.no_grad()
def braking_of(cars: Cars, car: Kinematics, lowest: float) -> Tensor:
    """[..., V - 1] how hard every car brakes for the next one ahead of it, by its car-following model, in m/s2."""
    model, reach = car.following, car.width + CLEARANCE
    place, speed = _middle(*cars.x), _middle(*cars.vx)
    gap = place.unsqueeze(-2) - place.unsqueeze(-1)
    same = (cars.y[0].unsqueeze(-2) < cars.y[1].unsqueeze(-1) + reach) & (
        cars.y[1].unsqueeze(-2) > cars.y[0].unsqueeze(-1) - reach
    )
    closing = speed.unsqueeze(-1) - speed.unsqueeze(-2)
    wanted = model.desired_gap(speed.unsqueeze(-1), closing)
    rate = model.acceleration * ((wanted.clamp(min=0) / gap.clamp(min=1)).square() - model.free_share)
    rate = torch.where(cars.present.unsqueeze(-2) & (gap > 0) & same, rate, 0.0).amax(-1)
    return rate.clamp(lowest, HARDEST)


def room_behind(cars: Cars, own: Tensor, length: float) -> Tensor:
    """[..., V - 1] the room that a car behind needs no part of to brake, if the ego drives at `own` m/s, [..., 1]."""
    closing = (cars.vx[1] - own).clamp(min=0)
    return -cars.x[1] - length - REAR_S * closing - closing.square() / (2 * REAR_BRAKING)


def cars_of(ego: Ego, boxes: Boxes) -> Cars:
    low, high = boxes.low[..., 1:, :], boxes.high[..., 1:, :]
    own = (None, ego.y, ego.speed * ego.heading.cos(), ego.speed * ego.heading.sin())
    bounds = [
        (low[..., place], high[..., place])
        if value is None
        else (low[..., place] + value.unsqueeze(-1), high[..., place] + value.unsqueeze(-1))
        for place, value in enumerate(own)
    ]
    return Cars(boxes.present[..., 1:], *bounds)


def _middle(low: Tensor, high: Tensor) -> Tensor:
    """The middle of an interval; where one bound is infinite, the other one; 0 where both are."""
    first, last = low.nan_to_num(0.0, 0.0, 0.0), high.nan_to_num(0.0, 0.0, 0.0)
    return (first + last) / (low.isfinite().to(low) + high.isfinite().to(low)).clamp(min=1)


def least(room: Tensor, counts: Tensor) -> Tensor:
    """The least room [..., lanes, options], from -`FREE` to `FREE`, over the cars that count, bool [..., V - 1, lanes]."""
    with torch.no_grad():
        least, car = torch.where(counts.unsqueeze(-1), room.unsqueeze(-2), FREE).min(-3)
    # The gradient through the car that was found is faster than through the choice.
    return torch.where(least < FREE, room.gather(-2, car), FREE).clamp(min=-FREE)
