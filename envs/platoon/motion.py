"""How the cars of a platoon move, and the laws by which those drive that no policy drives (compiled)."""

from __future__ import annotations

import math

from cavbench.compiled import inner

PERIOD = 0.1
"""Seconds per decision: the rate of cooperative awareness messages (ETSI EN 302 637-2, 10 Hz at most)."""
LENGTH, STANDSTILL = 5.0, 2.0
LAG = 0.1
"""Time constant of engine and brakes in s, of the cars of Ploeg et al. 2011."""
KP, KD = 0.2, 0.7
"""Gains in 1/s2 and 1/s of the controller of Ploeg et al. 2011 (section V)."""
ACCELERATION, BRAKING = 3.0, 8.0
AGENT, IDM, CACC, ACC, CLAIRVOYANT = range(5)
IDM_ACCELERATION, IDM_BRAKING, IDM_TIME_GAP, IDM_SPEED = 1.4, 2.0, 1.5, 40.0
"""IDM (Treiber et al. 2000): m/s2, m/s2, s, and a free speed in m/s that no cycle reaches."""
KEPT = math.exp(-PERIOD / LAG)
DELAY = 5
"""Decisions by which the driver with perfect information follows the car ahead: half a second."""


@inner
def clipped(command: float) -> float:
    """A command within what a car can do."""
    return min(max(command, -BRAKING), ACCELERATION)


@inner
def moved(x: float, v: float, a: float, u: float) -> tuple[float, float, float]:
    """Place, speed and acceleration after one decision with the command u: da/dt = (u - a) / LAG, and no reversing.

    The place is the integral of the speed by the trapezoidal rule, so whoever knows the speeds knows the way.
    """
    after = u + (a - u) * KEPT
    speed = v + u * PERIOD + (a - u) * LAG * (1 - KEPT)
    if speed <= 0:
        speed, after = 0.0, max(after, 0.0)
    return x + (v + speed) / 2 * PERIOD, speed, after


@inner
def cooperative(u: float, gap: float, closing: float, v: float, a: float, heard: float, headway: float) -> float:
    """The next command of the controller of Ploeg et al. 2011, whose last one was u: h du/dt = -u + kp e + kd de/dt + u of the
    car ahead.

    Args:
        gap: bumper to bumper, in m.
        closing: speed of the car ahead minus the own one, in m/s.
        heard: command of the car ahead in m/s2, 0 for ACC.
        headway: h in s.
    """
    error, change = gap - STANDSTILL - headway * v, closing - headway * a
    kept = math.exp(-PERIOD / headway)
    return clipped(kept * u + (1 - kept) * (KP * error + KD * change + heard))


@inner
def intelligent(gap: float, closing: float, v: float) -> float:
    """The command of the IDM."""
    wanted = IDM_TIME_GAP * v - v * closing / (2 * math.sqrt(IDM_ACCELERATION * IDM_BRAKING))
    wanted = STANDSTILL + max(wanted, 0.0)
    return clipped(IDM_ACCELERATION * (1 - (v / IDM_SPEED) ** 4 - (wanted / max(gap, 0.1)) ** 2))


@inner
def equilibrium(law: int, v: float, headway: float) -> float:
    """The gap in m at which a law neither accelerates nor brakes behind a car with the same speed."""
    if law == IDM:
        return (STANDSTILL + IDM_TIME_GAP * v) / math.sqrt(1 - (v / IDM_SPEED) ** 4)
    return STANDSTILL + headway * v
