"""How much room each action leaves in the worst case of the intervals, in m."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from bench.driving.intervals.boxes import Boxes
from bench.driving.intervals.ego import DeadReckoning, Ego
from bench.driving.intervals.following import FollowingDistance

FREE = 200.0
"""The margin where there is no car, in m."""
CROSSING_S = 0.8
"""Time in which the ego leaves a lane."""
STRADDLING = 1.4
"""The ego is still in the lane that it comes from while it is this far from the middle of its target lane, in m."""
DRIFT_S, DEAD_BAND = 0.6, 0.5
"""A car may be as far to the side as it gets in this time in s with the part of its lateral speed above this, in m/s."""
CLEARANCE = 0.4
"""Lateral room between two cars, in m, below which they are in the same lane."""
ROOM = 12.0
"""This much of the room to a car ahead does not count as free, in m."""
SIDES = (-4, -3, -2, -1, 0, 1, 2, 3, 4)
"""The lanes in question, relative to the ego's target lane."""


@dataclass(frozen=True, kw_only=True)
class Caution:
    """What is assumed of other cars.

    Args:
        braking: least rate at which a car ahead may brake, in m/s2.
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
        speed: the speed that each lane allows for, relative lanes `SIDES`, in m/s, [..., 3].
        settled: bool [...], whether the ego is in its target lane.
        straddled: -1 or 1, the side of the lane that the ego is leaving, 0 if there is none, [...].
    """

    stay: Tensor
    change: Tensor
    speed: Tensor
    settled: Tensor
    straddled: Tensor


class Judge:
    """Computes margins.

    Args:
        reckoning: the ego's kinematics.
        period: seconds per decision.
        caution: what is assumed of other cars.
        horizon: seconds in which free room ahead counts as speed.
    """

    def __init__(self, reckoning: DeadReckoning, period: float, caution: Caution, horizon: float = 5.0) -> None:
        self.reckoning, self.period, self.caution, self.horizon = reckoning, period, caution, horizon
        continuous = reckoning.action_type == "continuous"

        def distance(within: float | None = None) -> FollowingDistance:
            return FollowingDistance(
                reckoning.kinematics, period, caution.seconds, continuous=continuous, within=within
            )

        self.following, self.crossing = distance(), distance(CROSSING_S)

    def __call__(self, ego: Ego, boxes: Boxes) -> Margins:
        car, period = self.reckoning.kinematics, self.period
        present = boxes.present[..., 1:]
        low, high = boxes.low[..., 1:, :], boxes.high[..., 1:, :]
        along, across = ego.speed * ego.heading.cos(), ego.speed * ego.heading.sin()
        x_low, x_high = low[..., 0], high[..., 0]
        v_low, v_high = along.unsqueeze(-1) + low[..., 2], along.unsqueeze(-1) + high[..., 2]
        y_low = ego.y.unsqueeze(-1) + low[..., 1]
        y_high = ego.y.unsqueeze(-1) + high[..., 1]
        left = (across.unsqueeze(-1) + low[..., 3] + DEAD_BAND).clamp(max=0) * DRIFT_S
        right = (across.unsqueeze(-1) + high[..., 3] - DEAD_BAND).clamp(min=0) * DRIFT_S
        lanes = car.lane_width * (ego.target_lane.unsqueeze(-1) + torch.tensor(SIDES).to(ego.y))
        reach = car.width + CLEARANCE
        in_lane = ((y_high + right).unsqueeze(-1) > lanes.unsqueeze(-2) - reach) & (
            (y_low + left).unsqueeze(-1) < lanes.unsqueeze(-2) + reach
        )
        in_lane &= present.unsqueeze(-1)
        ahead = (x_low + x_high) > 0
        rate = self._rate(x_low, x_high, v_low, v_high, y_low, y_high, present, reach).unsqueeze(-1)

        options = torch.stack([self.reckoning.commanded(ego, change) for change in (1, 0, -1)], -1)
        own = self.reckoning.speed_after(Ego(*(value.unsqueeze(-1) for value in ego)), options)
        own, leader = own.unsqueeze(-2), v_low.clamp(min=0).unsqueeze(-1)
        gap = x_low + (v_low.clamp(min=0) - along.unsqueeze(-1)) * period - car.length - self.caution.distance
        in_near = in_lane[..., 3:6] & ahead.unsqueeze(-1)
        front = _least(gap.unsqueeze(-1) - self.following(own, leader, rate), in_near)
        cross = _least(gap.unsqueeze(-1) - self.crossing(own, leader, rate), in_near)
        closing = (v_high - own[..., 1]).clamp(min=0)
        room = -x_high - car.length - self.caution.distance - 0.14 * closing - closing.square() / 8
        rear = _least(room.unsqueeze(-1), in_lane[..., 3:6] & ~ahead.unsqueeze(-1))[..., 0]

        off = ego.y - car.lane_width * ego.target_lane
        straddled = torch.where(off.abs() > STRADDLING, off.sign(), 0.0)
        settled = (off.abs() < 0.5) & (ego.heading.abs() < 0.1)
        leaving = torch.where((straddled < 0).unsqueeze(-1), cross[..., 0, :], cross[..., 2, :])
        leaving = torch.where((straddled == 0).unsqueeze(-1), FREE, leaving)
        stay = torch.minimum(front[..., 1, :], leaving)
        change = torch.stack([front[..., 0, 1], front[..., 2, 1]], -1)
        change = torch.minimum(change, torch.stack([rear[..., 0], rear[..., 2]], -1))
        change = torch.minimum(change, cross[..., 1, 1].unsqueeze(-1))
        exists = torch.stack([ego.target_lane > 0, ego.target_lane < ego.edge], -1)
        change = torch.where(exists, change, -FREE)
        return Margins(stay, change, self._speeds(x_low, x_high, v_low, v_high, in_lane, ahead), settled, straddled)

    def _rate(
        self, x_low: Tensor, x_high: Tensor, v_low: Tensor, v_high: Tensor, y_low: Tensor, y_high: Tensor, present: Tensor, reach: float
    ) -> Tensor:
        """[..., V - 1] how hard every car brakes for the next one ahead of it, by the IDM (Treiber et al. 2000), in m/s2."""
        place = torch.where(x_high.isfinite(), (x_low + x_high) / 2, x_low)
        speed = torch.where(v_high.isfinite(), (v_low + v_high) / 2, v_low)
        other = present.unsqueeze(-2) & (place.unsqueeze(-2) > place.unsqueeze(-1))
        beside = (y_low.unsqueeze(-2) < y_high.unsqueeze(-1) + reach) & (
            y_high.unsqueeze(-2) > y_low.unsqueeze(-1) - reach
        )
        mix = self.mix
        gap = (mix * x_low + (1 - mix) * place).unsqueeze(-2) - (mix * torch.where(x_high.isfinite(), x_high, place) + (1 - mix) * place).unsqueeze(-1)
        closing = speed.unsqueeze(-1) - speed.unsqueeze(-2)
        wanted = 10 + 1.5 * speed.unsqueeze(-1) + speed.unsqueeze(-1) * closing / 7.746
        rate = 3 * (wanted.clamp(min=0) / gap.clamp(min=1)).square() - self.free
        rate = torch.where(other & beside, rate, 0.0).amax(-1)
        return rate.clamp(self.caution.braking, 6)

    mix, free = 0., 1.5

    def _speeds(
        self, x_low: Tensor, x_high: Tensor, v_low: Tensor, v_high: Tensor, in_lane: Tensor, ahead: Tensor
    ) -> Tensor:
        """[..., 3] the speed that the cars ahead allow for on each lane: theirs, and the free room over the horizon."""
        top = self.reckoning.kinematics.target_speeds[-1]
        place = torch.where(x_high.isfinite(), (x_low + x_high) / 2, x_low)
        speed = torch.where(v_high.isfinite(), (v_low + v_high) / 2, v_low)
        allowed = speed + (place - ROOM).clamp(min=0) / self.horizon
        counts = in_lane & ahead.unsqueeze(-1)
        return torch.where(counts, allowed.unsqueeze(-1), FREE).amin(-2).clamp(max=top)


def _least(room: Tensor, counts: Tensor) -> Tensor:
    """The least room [..., lanes, options] over the cars that count, bool [..., V - 1, lanes]."""
    return torch.where(counts.unsqueeze(-1), room.unsqueeze(-2), FREE).amin(-3)
