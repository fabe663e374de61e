"""Set-membership estimation: a car's box now is also limited by its box before and by how a car can move (Schweppe 1968)."""

from __future__ import annotations

from functools import cache

import numpy as np
from torch import Tensor

from cavbench.driving.intervals import bends, motion_kernels
from cavbench.driving.intervals.boxes import Boxes, flat, shaped
from cavbench.driving.intervals.ego import Ego, stacked
from cavbench.driving.kinematics import Kinematics

LONGITUDINAL, LATERAL = 6.0, 40.0
"""Largest accelerations of a car along its direction and across it, in m/s2 (of highway-env's IDMVehicle)."""
LARGEST_SLIP = 0.66
"""Sine of the largest angle between where a car points and where it moves (the bicycle model, steered by 60 degrees)."""
ROUNDING = 1e-3
"""Predicted boxes are wider by this on every side, in m and m/s."""


def predicted(boxes: Boxes, before: Ego, after: Tensor, car: Kinematics, period: float) -> Tensor:
    """The other cars one decision later, [B, V - 1, 9]: 1 if there is one, the lower and the upper bounds relative to the ego.

    Args:
        boxes: the boxes now, [B, V, 4].
        before: the ego now, [B] each.
        after: the ego's reckoned state one decision later, [B, 7].
        car: kinematics of the world's cars.
        period: seconds per decision.
    """
    if car.way is not None:
        return bends.predicted(boxes, before, after, car, _limits(car, period))
    low, high = flat(boxes.low, 2), flat(boxes.high, 2)
    tracks = np.empty((len(low), low.shape[1] - 1, 1 + 2 * low.shape[2]), np.float32)
    motion_kernels.later(
        flat(boxes.present, 1), low, high, stacked(before).numpy(), flat(after, 1), _limits(car, period), tracks
    )
    return shaped(tracks, boxes.low.shape[:-2], boxes.low)


@cache
def _limits(car: Kinematics, period: float) -> motion_kernels.Limits:
    """How a car may move in one decision.

    A car's speed v changes by at most `LONGITUDINAL`, its lateral speed by at most `LATERAL`. As vx = sqrt(v^2 - vy^2), it
    loses vx when it turns. A car that turns at the rate w slips sideways by w times half its length.
    """
    slipping = car.length / 2 * LATERAL
    found = period, LONGITUDINAL * period, LATERAL * period, slipping, LARGEST_SLIP, ROUNDING
    dt, gained, turned, slid, slip, wider = map(np.float32, found)
    return motion_kernels.Limits(dt, gained, turned, slid, slip, wider, oncoming=car.oncoming)
