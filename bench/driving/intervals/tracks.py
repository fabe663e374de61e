"""Set-membership estimation: a car's box now is also limited by its box before and by how a car can move (Schweppe 1968)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from bench.driving.intervals.boxes import Boxes
from bench.driving.intervals.ego import Ego

LONGITUDINAL, LATERAL = 6.0, 40.0
"""Largest accelerations of another car along and across the road, in m/s2."""
ROUNDING = 1e-3
"""Predicted boxes are wider by this on every side, in m and m/s."""


def predicted(boxes: Boxes, before: Ego, after: TensorDictBase, period: float) -> dict[str, Tensor]:
    """The boxes of the other cars one decision later, relative to the ego: `present` [B, V - 1], `low`, `high` [B, V - 1, 4].

    Args:
        boxes: the boxes now, [B, V, 4].
        before: the ego now, [B] each.
        after: the ego's reckoned state one decision later.
        period: seconds per decision.
    """
    cos, sin = before.heading.cos(), before.heading.sin()
    own = torch.stack([torch.zeros_like(cos), before.y, before.speed * cos, before.speed * sin], -1).unsqueeze(-2)
    heading = after["heading"]
    driven = (before.speed + after["speed"]) / 2 * cos * period
    then = torch.stack([driven, after["y"], after["speed"] * heading.cos(), after["speed"] * heading.sin()], -1)
    reach = torch.tensor([LONGITUDINAL, LATERAL]).to(cos) * period
    bounds = []
    for side, bound in ((-1.0, boxes.low), (1.0, boxes.high)):
        place, speed = (bound[..., 1:, :] + own).split(2, -1)
        moved = place + (speed + side * reach) * period
        bounds.append(torch.cat((moved, speed + side * reach), -1) - then.unsqueeze(-2) + side * ROUNDING)
    return {"present": boxes.present[..., 1:], "low": bounds[0], "high": bounds[1]}


def narrowed(boxes: Boxes, tracks: TensorDictBase) -> Boxes:
    """The boxes [..., V, 4], each intersected with the hull of all predicted boxes that it may belong to.

    The hull makes it sound where a measurement fits several cars. A box that fits none, or whose intersection is empty, stays.

    Args:
        tracks: the result of `predicted` for the same episodes.
    """
    low, high = boxes.low[..., 1:, :], boxes.high[..., 1:, :]
    track_low, track_high = tracks["low"], tracks["high"]
    meet = (low.unsqueeze(-2) <= track_high.unsqueeze(-3)) & (track_low.unsqueeze(-3) <= high.unsqueeze(-2))
    # New cars appear where the sensor's range ends.
    known = boxes.present[..., 1:] & high[..., 0].isfinite()
    fits = meet.all(-1) & tracks["present"].unsqueeze(-2) & known.unsqueeze(-1)
    hull_low = torch.where(fits.unsqueeze(-1), track_low.unsqueeze(-3), torch.inf).amin(-2)
    hull_high = torch.where(fits.unsqueeze(-1), track_high.unsqueeze(-3), -torch.inf).amax(-2)
    ego_low, ego_high = boxes.low[..., :1, :], boxes.high[..., :1, :]
    matched = torch.cat((torch.zeros_like(fits[..., :1, 0]), fits.any(-1)), -1)
    return boxes.meet(torch.cat((ego_low, hull_low), -2), torch.cat((ego_high, hull_high), -2), matched)
