"""Does the car stop? What a fixed controller makes of the frames in which a stop sign was detected.

The car comes at a constant speed. Once the sign is confirmed it brakes, after its reaction time, as hard as it must to stop at
the line, and at least comfortably. The line is level with the sign: it is 0 m away when the distance to the sign is 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

THRESHOLD = 0.25
"""Confidence from which a sign counts as detected: YOLOv5's own default."""
CONFIRMED_IN, OF_THE_LAST = 3, 5
"""Frames in which a sign must be detected, of so many."""
SPEED_MPS = 10.0
"""Of the approach: 36 km/h."""
REACTION_S = 0.75
"""From confirmation to full braking: the delay of UN Regulation 157's competent and careful driver (Annex 3, guidance)."""
GREATEST_DECELERATION = 0.774 * 9.81
"""Of the same driver, in m/s^2. Up to it the car brakes as hard as it must."""
COMFORTABLE_DECELERATION = 3.4
"""In m/s^2 (AASHTO, A Policy on Geometric Design of Highways and Streets): the least it brakes with."""
RAN_M = 1.0
"""A car that stops farther than this beyond the line has run the sign."""


def confirmed(detected: Flags) -> Flags:
    """[A, F] whether the sign was detected in 3 of the last 5 frames; frames [A, F] in the order they are driven through."""
    counted = np.cumsum(np.pad(detected, ((0, 0), (OF_THE_LAST, 0))), 1)
    return np.asarray(counted[:, OF_THE_LAST:] - counted[:, :-OF_THE_LAST] >= CONFIRMED_IN)


def first(flags: Flags, distance_m: Array) -> Array:
    """[A] distance in m at which a flag is set first; 0 where it never is."""
    return np.where(flags.any(1), np.take_along_axis(distance_m, flags.argmax(1)[:, None], 1)[:, 0], 0.0)


def deceleration(confirmed_m: Array) -> Array:
    """[A] what the car brakes with, in m/s^2, when the sign is confirmed at these distances (0: when it is passed)."""
    room = np.maximum(confirmed_m - SPEED_MPS * REACTION_S, 1e-3)
    needed = SPEED_MPS**2 / (2 * room)
    return np.clip(needed, COMFORTABLE_DECELERATION, GREATEST_DECELERATION)


def overrun_m(confirmed_m: Array) -> Array:
    """[A] how far beyond the line the car stops, in m; 0 where it stops before it.

    A sign that is never confirmed counts as confirmed at the line: the largest overrun there is, 14.1 m.
    """
    stops_after = SPEED_MPS * REACTION_S + SPEED_MPS**2 / (2 * deceleration(confirmed_m))
    beyond = stops_after - confirmed_m
    return np.where(beyond > 1e-9, beyond, 0.0)


def ran(confirmed_m: Array) -> Flags:
    """[A] whether the car ran the sign: it never braked for it, or stopped more than a metre too late."""
    return (confirmed_m <= 0) | (overrun_m(confirmed_m) > RAN_M)
