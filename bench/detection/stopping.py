"""Whether the car stops: a fixed controller brakes for the stop sign according to the frames in which it was detected.

The car approaches at a constant speed. After the sign is confirmed and the reaction time has passed, it brakes as hard as
necessary to stop at the line, but at least comfortably. The line is level with the sign.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

THRESHOLD = 0.25
"""A sign counts as detected if the confidence is above this: YOLOv5's default."""
CONFIRMED_IN, OF_THE_LAST = 3, 5
"""A sign is confirmed if it is detected in 3 of the last 5 frames."""
SPEED_MPS = 10.0
"""Speed of the approach: 36 km/h."""
REACTION_S = 0.75
"""Time from confirmation to full braking: the delay of UN Regulation 157's competent and careful driver (Annex 3, guidance)."""
GREATEST_DECELERATION = 0.774 * 9.81
"""Largest deceleration in m/s^2, of the same driver."""
COMFORTABLE_DECELERATION = 3.4
"""Smallest deceleration in m/s^2 (AASHTO, A Policy on Geometric Design of Highways and Streets)."""
RAN_M = 1.0
"""A car that stops more than this beyond the line has run the sign, in m."""
EARLY_M = 6.6
"""A car that stops more than this before the line has stopped for something else, in m. From there it is 30 feet (9.1 m) to the
crossing road: the farthest place of a stop line (MUTCD 2009, section 3B.16)."""


def confirmed(detected: Flags) -> Flags:
    """[A, F] whether the sign was detected in 3 of the last 5 frames; `detected` [A, F] is in driving order."""
    counted = np.cumsum(np.pad(detected, ((0, 0), (OF_THE_LAST, 0))), 1)
    return np.asarray(counted[:, OF_THE_LAST:] - counted[:, :-OF_THE_LAST] >= CONFIRMED_IN)


def first(flags: Flags, distance_m: Array) -> Array:
    """[A] distance in m at which a flag is first set; 0 if it is never set."""
    return np.where(flags.any(1), np.take_along_axis(distance_m, flags.argmax(1)[:, None], 1)[:, 0], 0.0)


def deceleration(confirmed_m: Array) -> Array:
    """[A] deceleration of the car in m/s^2 if the sign is confirmed at these distances in m (0: at the line)."""
    room = np.maximum(confirmed_m - SPEED_MPS * REACTION_S, 1e-3)
    needed = SPEED_MPS**2 / (2 * room)
    return np.clip(needed, COMFORTABLE_DECELERATION, GREATEST_DECELERATION)


def overrun_m(confirmed_m: Array) -> Array:
    """[A] distance beyond the line at which the car stops, in m; 0 if it stops before the line.

    A sign that is never confirmed counts as confirmed at the line, which gives the largest overrun, 14.1 m.
    """
    stops_after = SPEED_MPS * REACTION_S + SPEED_MPS**2 / (2 * deceleration(confirmed_m))
    beyond = stops_after - confirmed_m
    return np.where(beyond > 1e-9, beyond, 0.0)


def ran(confirmed_m: Array) -> Flags:
    """[A] whether the car ran the sign: it never braked, or stopped more than `RAN_M` beyond the line."""
    return (confirmed_m <= 0) | (overrun_m(confirmed_m) > RAN_M)
