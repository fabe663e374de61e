"""Random numbers that follow from what they are for, so that no episode depends on another (compiled)."""

from __future__ import annotations

import math

import numpy as np

from cavbench.compiled import inner

GAMMA, FIRST, SECOND = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
TINY = 2.0**-53


@inner
def uniform(seed: int, what: int, first: int, second: int) -> float:
    """A number in [0, 1): SplitMix64 (Steele, Lea and Flood 2014) over the four numbers."""
    value = np.uint64(0)
    for part in (seed, what, first, second):
        value = (value ^ np.uint64(part)) + GAMMA
        value = (value ^ (value >> np.uint64(30))) * FIRST
        value = (value ^ (value >> np.uint64(27))) * SECOND
        value = value ^ (value >> np.uint64(31))
    return float(value >> np.uint64(11)) * TINY


@inner
def normal(seed: int, what: int, first: int, second: int) -> float:
    """A number with mean 0 and deviation 1 (Box and Muller 1958)."""
    radius = math.sqrt(-2 * math.log(1 - uniform(seed, what, first, 2 * second)))
    return radius * math.cos(2 * math.pi * uniform(seed, what, first, 2 * second + 1))
