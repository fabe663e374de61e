"""Room to the cars around in the worst case of the intervals: the compiled loops of `kernels` as differentiable functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from cavbench.driving.intervals import kernels
from cavbench.driving.intervals.bends import paths
from cavbench.driving.intervals.boxes import Boxes, flat, shaped
from cavbench.driving.intervals.ego import DeadReckoning, Ego
from cavbench.driving.intervals.following import FollowingDistance
from cavbench.driving.kinematics import Kinematics


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


class Cars(NamedTuple):
    """The other cars: bounds of x relative to the ego, and of y, vx and vy in the road's frame.

    Args:
        present: bool [..., V - 1].
        low, high: [..., V - 1, 4].
    """

    present: Tensor
    low: Tensor
    high: Tensor

    def rightmost(self, lane_width: float) -> Tensor:
        """The number of the rightmost lane [...] that a car is surely in; 0 without a car."""
        return torch.where(self.present, self.low[..., 1] / lane_width, 0.0).amax(-1).round()


def cars_of(ego: Ego, boxes: Boxes, car: Kinematics | None = None) -> Cars:
    """The other cars of boxes; if the lanes bend, which the kinematics say, as on a straight road."""
    if car is not None and car.way is not None:
        return Cars(boxes.present[..., 1:], *paths(ego, boxes, car))
    along, across = ego.speed * ego.heading.cos(), ego.speed * ego.heading.sin()
    own = torch.stack([torch.zeros_like(along), ego.y, along, across], -1).unsqueeze(-2)
    return Cars(boxes.present[..., 1:], boxes.low[..., 1:, :] + own, boxes.high[..., 1:, :] + own)


class Rooms:
    """Computes rooms.

    Args:
        reckoning: the ego's kinematics.
        period: seconds per decision.
        caution: what is assumed of other cars.
        following: following distances.
        steady: number of the option that keeps the speed.
        asked: for each table of following distances the options whose room is computed; that of others is `FREE`.
    """

    def __init__(
        self,
        reckoning: DeadReckoning,
        period: float,
        caution: Caution,
        following: FollowingDistance,
        *,
        steady: int,
        asked: tuple[Sequence[int], ...],
    ) -> None:
        car = reckoning.kinematics
        self.asked = np.zeros((len(asked), 1 + max(option for options in asked for option in options)), np.bool_)
        for table, options in enumerate(asked):
            self.asked[table, list(options)] = True
        model = car.following
        self.following, self.top = following, car.target_speeds[-1]
        self.rules = kernels.Rules(
            period=period,
            length=car.length + caution.distance,
            width=car.width + kernels.CLEARANCE,
            lane_width=car.lane_width,
            braking=caution.braking,
            acceleration=model.acceleration,
            jam_distance=model.jam_distance,
            time_gap=model.time_gap,
            free_share=model.free_share,
            scale=model.scale,
            steady=steady,
            delay=1 / car.speed_gain,
            meeting=following.meeting,
        )

    def __call__(self, ego: Ego, cars: Cars, own: Tensor, slowing: Tensor) -> tuple[Tensor, Tensor]:
        """The least room in m, from -`FREE` to `FREE`, on the lanes to the left, own and right.

        Args:
            ego: the ego's motion.
            cars: the other cars.
            own: the ego's speed after each option, [..., O].
            slowing: by how much the ego slows down after that while a car behind reacts, in m/s, at least 0, [..., O].

        Returns:
            To the cars ahead, [..., T, 3, O], one for each table of following distances; and to the cars behind, [..., 3, O].
        """
        along = ego.speed * ego.heading.cos()
        lane = self.rules.lane_width * ego.target_lane
        front, rear = _Rooms.apply(cars.low, cars.high, along, own, slowing.detach(), cars.present, lane, self)
        return front, rear

    def speeds(self, ego: Ego, cars: Cars) -> Tensor:
        """[..., 9] the speed in m/s that each of the lanes `SIDES` allows for: the cars', and the free room over the horizon."""
        lane = self.rules.lane_width * ego.target_lane
        fastest: Tensor = _Speeds.apply(cars.low, cars.high, cars.present, lane, self)
        return fastest


class _Rooms(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        low: Tensor,
        high: Tensor,
        along: Tensor,
        own: Tensor,
        slowing: Tensor,
        present: Tensor,
        lane: Tensor,
        of: Rooms,
    ) -> tuple[Tensor, Tensor]:
        shape, options, tables = along.shape, own.shape[-1], len(of.following.tables)
        given = flat(low, 2), flat(high, 2), flat(along, 0), flat(own, 1)
        slower, (count, cars) = flat(slowing, 1), given[0].shape[:2]
        front = np.empty((count, tables, 3, options), np.float32)
        rear = np.empty((count, 3, options), np.float32)
        found = np.empty(front.shape, np.int8), np.empty(rear.shape, np.int8), np.zeros((count, cars), np.int8)
        kernels.rooms(
            given[0],
            given[1],
            flat(present, 1),
            given[2],
            flat(lane, 0),
            given[3],
            slower,
            of.following.tables,
            of.following.side,
            of.asked[None],
            of.rules,
            front,
            found[0],
            rear,
            found[1],
            found[2],
        )
        ctx.of, ctx.flat, ctx.slower, ctx.found = of, given, slower, found
        ctx.shapes, ctx.like = [each.shape for each in (low, high, along, own)], low.new_empty(0)
        return shaped(front, shape, low), shaped(rear, shape, low)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_front: Tensor, by_rear: Tensor) -> tuple[Tensor | None, ...]:
        gradients = [np.zeros_like(each) for each in ctx.flat]
        kernels.rooms_backward(
            *ctx.flat,
            ctx.slower,
            ctx.of.following.tables,
            ctx.of.following.side,
            ctx.of.rules,
            *ctx.found,
            flat(by_front, 3),
            flat(by_rear, 2),
            *gradients,
        )
        back = [torch.from_numpy(each).to(ctx.like).reshape(to) for each, to in zip(gradients, ctx.shapes, strict=True)]
        return *back, None, None, None, None


class _Speeds(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, low: Tensor, high: Tensor, present: Tensor, lane: Tensor, of: Rooms) -> Tensor:
        given = flat(low, 2), flat(high, 2)
        fastest = np.empty((len(given[0]), len(kernels.SIDES)), np.float32)
        car = np.empty(fastest.shape, np.int8)
        kernels.speeds(*given, flat(present, 1), flat(lane, 0), of.rules, of.top, fastest, car)
        ctx.flat, ctx.car, ctx.shape, ctx.like = given, car, low.shape, low.new_empty(0)
        return shaped(fastest, lane.shape, low)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_fastest: Tensor) -> tuple[Tensor | None, ...]:
        by_low, by_high = (np.zeros_like(each) for each in ctx.flat)
        kernels.speeds_backward(*ctx.flat, ctx.car, flat(by_fastest, 1), by_low, by_high)
        back = [torch.from_numpy(each).to(ctx.like).reshape(ctx.shape) for each in (by_low, by_high)]
        return *back, None, None, None
