"""Invented cars move as cars can: the nearest car that the rules of motion allow, from one frame to the next."""

from __future__ import annotations

import torch
from torch import Tensor

from cavbench.driving.features import Features

TOP_SPEED = 40.0
"""No car drives faster, in m/s, and none drives backwards."""
LATERAL_SPEED = 4.0
"""No car moves faster across the road, in m/s."""
ACCELERATION = 9.0
"""No car changes its speed faster, in m/s2: an emergency braking on a dry road."""
TOLERANCE = 0.1
"""A position may differ by this from what the speeds say, in m."""
NEEDED = ("x", "y", "vx", "vy")


def plausible(
    cars: Tensor, ego: Tensor, before: Tensor, ego_before: Tensor, features: Features, period: float
) -> Tensor:
    """The nearest plausible cars.

    A car that was not there before may appear anywhere in the sensor's range. One that was may have changed its speed by
    `ACCELERATION` times the period, and is where its mean speed has brought it.

    Args:
        cars: rows of invented cars [B, K, F], relative to the ego; presence above 0 means that the car is there.
        ego: row of the ego in this frame [B, F].
        before: invented cars of the frame before [B, K, F], after this function.
        ego_before: row of the ego in the frame before [B, F].
        features: features of the observation, with x, y, vx and vy.
        period: seconds between the frames.

    Returns:
        Rows [B, K, F] within [-1, 1], with presence 0 or 1; zeros where no car is.
    """
    there = cars[..., 0] > 0
    clipped = cars.clamp(-1.0, 1.0)
    lasting = there & (before[..., 0] > 0)
    now, past = features.physical(clipped), features.physical(before)
    own, own_past = features.physical(ego)[:, None], features.physical(ego_before)[:, None]
    for place, speed, slowest, fastest in (("x", "vx", 0.0, TOP_SPEED), ("y", "vy", -LATERAL_SPEED, LATERAL_SPEED)):
        at, rate = features.names.index(place), features.names.index(speed)
        ego_speed, ego_earlier = own[..., rate], own_past[..., rate]
        earlier = past[..., rate] + ego_earlier
        moving = (now[..., rate] + ego_speed).clamp(slowest, fastest)
        change = ACCELERATION * period
        moving = torch.where(lasting, moving.clamp(earlier - change, earlier + change), moving)
        reached = past[..., at] + period * ((moving + earlier) - (ego_speed + ego_earlier)) / 2
        placed = torch.where(lasting, now[..., at].clamp(reached - TOLERANCE, reached + TOLERANCE), now[..., at])
        now[..., rate], now[..., at] = moving - ego_speed, placed
    rows = torch.cat((torch.ones_like(now[..., :1]), features.normalised(now)), -1).clamp(-1.0, 1.0)
    # A car that has left the sensor's range is not there any more.
    low, high = (torch.tensor(end).to(now) for end in (features.low, features.high))
    outside = (now < low - TOLERANCE).any(-1) | (now > high + TOLERANCE).any(-1)
    return rows.masked_fill(~(there & ~outside)[..., None], 0.0)
