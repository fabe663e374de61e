"""Set-membership estimation: a car's box now is also limited by its box before and by how a car can move (Schweppe 1968)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from bench.driving.intervals.boxes import Boxes
from bench.driving.intervals.ego import Ego
from bench.driving.kinematics import Kinematics

LONGITUDINAL, LATERAL = 6.0, 40.0
"""Largest accelerations of a car along its direction and across it, in m/s2 (of highway-env's IDMVehicle)."""
LARGEST_SLIP = 0.66
"""Sine of the largest angle between where a car points and where it moves (the bicycle model, steered by 60 degrees)."""
ROUNDING = 1e-3
"""Predicted boxes are wider by this on every side, in m and m/s."""


def predicted(boxes: Boxes, before: Ego, after: TensorDictBase, car: Kinematics, period: float) -> dict[str, Tensor]:
    """The boxes of the other cars one decision later, relative to the ego: `present` [B, V - 1], `low`, `high` [B, V - 1, 4].

    Args:
        boxes: the boxes now, [B, V, 4].
        before: the ego now, [B] each.
        after: the ego's reckoned state one decision later.
        car: kinematics of the world's cars.
        period: seconds per decision.
    """
    cos, sin = before.heading.cos(), before.heading.sin()
    own = torch.stack([torch.zeros_like(cos), before.y, before.speed * cos, before.speed * sin], -1).unsqueeze(-2)
    heading = after["heading"]
    driven = (before.speed + after["speed"]) / 2 * cos * period
    then = torch.stack([driven, after["y"], after["speed"] * heading.cos(), after["speed"] * heading.sin()], -1)
    low, high = _later((boxes.low[..., 1:, :] + own), (boxes.high[..., 1:, :] + own), car, period)
    then = then.unsqueeze(-2)
    return {"present": boxes.present[..., 1:], "low": low - then - ROUNDING, "high": high - then + ROUNDING}


def _later(low: Tensor, high: Tensor, car: Kinematics, period: float) -> tuple[Tensor, Tensor]:
    """Bounds [..., 4] of x, y, vx and vy one decision later, in the road's frame.

    A car's speed v changes by at most `LONGITUDINAL`, its lateral speed by at most `LATERAL`. As vx = sqrt(v^2 - vy^2), it
    loses vx when it turns. A car that turns at the rate w slips sideways by w times half its length.
    """
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
    return torch.stack([x_low, y_low, vx, vy_low], -1), torch.stack(
        [x_high + fastest * period, y_high, fastest, vy_high], -1
    )


def narrowed(boxes: Boxes, tracks: TensorDictBase) -> Boxes:
    """The boxes [..., V, 4], each intersected with the hull of all predicted boxes that it may belong to.

    The hull makes it sound where a measurement fits several cars. A box that fits none, or whose intersection is empty, stays.

    Args:
        tracks: the result of `predicted` for the same episodes.
    """
    low, high = boxes.low[..., 1:, :].mT.unsqueeze(-2), boxes.high[..., 1:, :].mT.unsqueeze(-2)
    track_low, track_high = tracks["low"].mT.unsqueeze(-1), tracks["high"].mT.unsqueeze(-1)
    # New cars appear where the sensor's range ends.
    known = boxes.present[..., 1:] & boxes.high[..., 1:, 0].isfinite()
    fits = tracks["present"].unsqueeze(-1) & known.unsqueeze(-2)
    # One feature after the other: a reduction over four is slower.
    for feature in range(low.shape[-3]):
        fits = fits & (low[..., feature, :, :] <= track_high[..., feature, :, :])
        fits = fits & (track_low[..., feature, :, :] <= high[..., feature, :, :])
    others = torch.where(fits, 0.0, torch.inf).unsqueeze(-3)
    hull_low, hull_high = _least(track_low, others), -_least(-track_high, others)
    ego_low, ego_high = boxes.low[..., :1, :], boxes.high[..., :1, :]
    matched = torch.cat((torch.zeros_like(fits[..., :1, 0]), fits.any(-2)), -1)
    return boxes.meet(torch.cat((ego_low, hull_low), -2), torch.cat((ego_high, hull_high), -2), matched)


def _least(bound: Tensor, others: Tensor) -> Tensor:
    """The least bound [..., V, F] of those that count; it may be infinite.

    Args:
        bound: [..., F, T, 1] of the tracks.
        others: 0 for the tracks that count and infinite for the others, [..., 1, T, V].
    """
    end = torch.finfo(bound.dtype).max
    # A sum is faster than a choice, but has no result for opposite infinities.
    least = (bound.clamp(-end, end) + others).amin(-2)
    return torch.where(least <= -end, -torch.inf, least).mT
