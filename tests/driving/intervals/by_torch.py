"""What the compiled loops compute, in torch: the reference of their tests."""

from __future__ import annotations

import torch
from torch import Tensor

from cavbench.driving.intervals.boxes import ALONG, Assumed, Boxes
from cavbench.driving.intervals.ego import DeadReckoning, Ego
from cavbench.driving.intervals.tracks import LARGEST_SLIP, LATERAL, LONGITUDINAL, ROUNDING
from cavbench.driving.kinematics import Kinematics


def boxes(assumed: Assumed, shown: Tensor) -> Boxes:
    """`Assumed.boxes`, differentiable."""
    features, measured = assumed.features, shown[..., 1:]
    half = features.half_range()
    centre = (torch.tensor(features.low) + torch.tensor(features.high)) / 2
    value = measured * half + centre
    if assumed.norm == "linf":
        reach = assumed.budget * half
        low, high = value - reach, value + reach
    else:
        floor = torch.tensor(features.floors or (0.0,) * len(features.names)) * (assumed.budget / 0.1)
        larger, smaller = value / max(1 - assumed.budget, 1e-3), value / (1 + assumed.budget)
        low = torch.minimum(value - floor, torch.minimum(larger, smaller))
        high = torch.maximum(value + floor, torch.maximum(larger, smaller))
    forged = features.forgeable() > 0
    low, high = torch.where(forged, low, value), torch.where(forged, high, value)
    noise = torch.tensor([assumed.noise if name in ALONG else 0.0 for name in features.names])
    noise = noise * (torch.arange(value.shape[-2]) > 0).unsqueeze(-1)
    low, high = low - noise, high + noise
    end = half * (1 - 1e-5)
    low = torch.where(low - centre <= -end, -torch.inf, low)
    high = torch.where(high - centre >= end, torch.inf, high)
    return Boxes(shown[..., 0] > 0, low, high)


def after(of: DeadReckoning, ego: Ego, action: Tensor) -> Ego:
    """`DeadReckoning.after`."""
    car = of.kinematics
    if of.action_type == "continuous":
        action = action.clamp(-1, 1)
        for _ in range(car.frames):
            ego = _moved(of, ego, action[..., 0] * car.acceleration_limit, action[..., 1] * car.steering_limit)
        return ego._replace(target_lane=torch.minimum((ego.y / car.lane_width).round().clamp(min=0), ego.edge))
    target, lane, width = ego.target_speed, ego.target_lane, car.lane_width
    for name, change in (("FASTER", 1), ("SLOWER", -1)):
        target = torch.where(action == of.numbers[name], of.commanded(ego, change), target)
    for name, change in (("LANE_RIGHT", 1), ("LANE_LEFT", -1)):
        lane = torch.where(action == of.numbers[name], lane + change, lane)
    lane = torch.minimum(lane.clamp(min=0), ego.edge)
    lane = torch.where((ego.y - width * lane).abs() <= 2 * width, lane, ego.target_lane)
    ego = ego._replace(target_lane=lane, target_speed=target)
    for _ in range(car.frames):
        ego = _moved(of, ego, car.speed_gain * (target - ego.speed), of.steering(ego, width * ego.target_lane))
    return ego


def _moved(of: DeadReckoning, ego: Ego, acceleration: Tensor, steering: Tensor) -> Ego:
    car, dt = of.kinematics, of.dt
    excess = ego.speed - car.top_speed
    acceleration = torch.where(excess > 0, torch.minimum(acceleration, -excess), acceleration)
    slip = (0.5 * steering.tan()).atan()
    y = ego.y + ego.speed * (ego.heading + slip).sin() * dt
    heading = ego.heading + ego.speed * slip.sin() / (car.length / 2) * dt
    return ego._replace(y=y, heading=heading, speed=ego.speed + acceleration * dt)


def predicted(found: Boxes, before: Ego, then: Ego, car: Kinematics, period: float) -> tuple[Tensor, Tensor]:
    """`tracks.predicted`: the lower and the upper bounds."""
    cos, sin = before.heading.cos(), before.heading.sin()
    own = torch.stack([torch.zeros_like(cos), before.y, before.speed * cos, before.speed * sin], -1).unsqueeze(-2)
    driven = (before.speed + then.speed) / 2 * cos * period
    there = torch.stack([driven, then.y, then.speed * then.heading.cos(), then.speed * then.heading.sin()], -1)
    low, high = found.low[..., 1:, :] + own, found.high[..., 1:, :] + own
    (x_low, y_low, vx_low, vy_low), (x_high, y_high, vx_high, vy_high) = low.unbind(-1), high.unbind(-1)
    across = torch.maximum(-vy_low, vy_high)
    slowest = torch.hypot(vx_low.clamp(min=0), torch.maximum(vy_low, -vy_high).clamp(min=0))
    fastest = torch.hypot(vx_high, across) + LONGITUDINAL * period
    slip = (car.length / 2 * LATERAL / slowest.clamp(min=0.1).square()).clamp(max=LARGEST_SLIP)
    across = across + LATERAL * period
    vx = ((slowest - LONGITUDINAL * period).clamp(min=0).square() - across.square()).clamp(min=0).sqrt()
    vy_low, vy_high = vy_low - LATERAL * period, vy_high + LATERAL * period
    x_low = x_low + (vx * (1 - slip.square()).sqrt() - across * slip) * period
    y_low, y_high = y_low + (vy_low - fastest * slip) * period, y_high + (vy_high + fastest * slip) * period
    lower = torch.stack([x_low, y_low, vx, vy_low], -1)
    upper = torch.stack([x_high + fastest * period, y_high, fastest, vy_high], -1)
    return lower - there.unsqueeze(-2) - ROUNDING, upper - there.unsqueeze(-2) + ROUNDING


def narrowed(found: Boxes, low: Tensor, high: Tensor, tracked: Tensor) -> Boxes:
    """`Assumed.boxes` with tracks: bounds [N, K, F] each, and which exist, [N, K]."""
    own = found.low[:, 1:, None], found.high[:, 1:, None]
    known = found.present[:, 1:] & found.high[:, 1:, 0].isfinite()
    fits = (own[0] <= high[:, None]) & (low[:, None] <= own[1])
    fits = (fits.all(-1) & known.unsqueeze(-1) & tracked[:, None]).unsqueeze(-1)
    lower = torch.maximum(found.low[:, 1:], torch.where(fits, low[:, None], torch.inf).amin(2))
    upper = torch.minimum(found.high[:, 1:], torch.where(fits, high[:, None], -torch.inf).amax(2))
    keep = fits.any(2) & (lower <= upper)
    lower, upper = torch.where(keep, lower, found.low[:, 1:]), torch.where(keep, upper, found.high[:, 1:])
    return Boxes(found.present, torch.cat((found.low[:, :1], lower), 1), torch.cat((found.high[:, :1], upper), 1))
