"""The closed form of what a follower makes of the motion of the car ahead, sampled as the world is."""

from __future__ import annotations

import cmath
import math

PERIOD, LAG = 0.1, 0.1


def gain(omega: float, headway: float, kp: float, kd: float, *, told: bool) -> float:
    """|Gamma| at omega in rad/s: the amplitude of a follower's acceleration over that of the car ahead.

    With U the command, the car moves by A(z), V(z), X(z) = acceleration, speed and place over U. The controller is
    U = k U/z + (1 - k) (kp E + kd D + told U_ahead/z), with E = X_ahead - X - h V, D = V_ahead - V - h A and k = exp(-T/h).

    Args:
        told: whether the car ahead tells its command (CACC), or not (ACC).
    """
    z, left = cmath.exp(1j * omega * PERIOD), math.exp(-PERIOD / LAG)
    a = (1 - left) / (z - left)
    v = (PERIOD - LAG * (1 - left) + LAG * (1 - left) * a) / (z - 1)
    x = v * (z + 1) / 2 * PERIOD / (z - 1)
    kept = math.exp(-PERIOD / headway)
    ahead = (1 - kept) * (kp * x + kd * v + (1 / z if told else 0))
    own = 1 - kept / z + (1 - kept) * (kp * (x + headway * v) + kd * (v + headway * a))
    return abs(ahead / own)


def worst(headway: float, kp: float, kd: float, *, told: bool) -> float:
    """The largest |Gamma| over the frequencies from 0.02 rad/s to half the sampling rate."""
    steps = [0.02 * (math.pi / PERIOD / 0.02) ** (place / 2000) for place in range(2001)]
    return max(gain(omega, headway, kp, kd, told=told) for omega in steps)
