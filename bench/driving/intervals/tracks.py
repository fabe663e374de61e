"""Set-membership estimation: a car's box now is also limited by its box before and by how a car can move (Schweppe 1968)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cavbench.driving.intervals.boxes import Boxes
from cavbench.driving.intervals.ego import Ego
from cavbench.driving.intervals.rooms import met
from cavbench.driving.kinematics import Kinematics

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
    # New cars appear where the sensor's range ends.
    known = boxes.present[..., 1:] & boxes.high[..., 1:, 0].isfinite()
    low, high = met(
        boxes.low[..., 1:, :], boxes.high[..., 1:, :], known, (tracks["low"], tracks["high"], tracks["present"])
    )
    ego_low, ego_high = boxes.low[..., :1, :], boxes.high[..., :1, :]
    return Boxes(boxes.present, torch.cat((ego_low, low), -2), torch.cat((ego_high, high), -2))
