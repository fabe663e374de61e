"""The safe distance of responsibility-sensitive safety (Shalev-Shwartz, Shammah and Shashua 2017, definition 1)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

RESPONSE_S = 0.5
"""Response time of the rear car in s (rho)."""
ACCELERATION = 3.0
"""The rear car may accelerate with so many m/s2 until it responds (a_max,accel)."""
BRAKING = 4.0
"""It then brakes with at least so many m/s2 (b_min,brake)."""
HARDEST = 8.0
"""The car ahead brakes with at most so many m/s2 (b_max,brake)."""


def safe_distance(rear: NDArray[Any], front: NDArray[Any]) -> NDArray[Any]:
    """The distance in m, bumper to bumper, at which the rear car stops in time whatever the car ahead does; at least 0.

    Args:
        rear, front: speeds of the two cars in m/s, of the same shape.
    """
    rear, front = np.maximum(rear, 0.0), np.maximum(front, 0.0)
    later = rear + RESPONSE_S * ACCELERATION
    meanwhile = rear * RESPONSE_S + ACCELERATION * RESPONSE_S**2 / 2
    return np.maximum(meanwhile + later**2 / (2 * BRAKING) - front**2 / (2 * HARDEST), 0.0)
