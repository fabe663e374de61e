"""By how much this machine's C library is wrong in the angles of steering, besides the rounding.

    python -m tests.envs.roads.angle_errors [SINES]

prints the largest errors in ulp of the six functions that `steered` replaces, for so many sines in each of 22 intervals.
"""

from __future__ import annotations

import itertools
import sys

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point
from cavbench.envs.roads.angles import (
    SHARES,
    SLIP,
    STEERING,
    STEPS,
    TABLE,
    c_asin,
    c_atan,
    c_sin,
    c_tan,
    evaluated,
    nearest_point,
    tangent_pair,
)
from cavbench.envs.roads.state import Floats

FUNCTIONS = ("asin(s)", "tan(a)", "atan(2t)", "tan(d)", "atan(u)", "sin(b)")
EDGES = (1e-5, 0.01, 0.03, 0.0302, 0.0312, 0.0315, 0.05, 0.0608, 0.0613, 0.0625, 0.0645, 0.08)
EDGES += (0.1, 0.124, 0.126, 0.14, 0.18, 0.25, 0.3, 0.4, 0.5, 0.6, 0.66)


@entry_point
def measure(sines: Floats, results: Floats, errors: Floats, assumed: Floats) -> None:
    """Of the positive sines [N]: the C library's results, what they lack, and what is assumed, [N, 6] each."""
    for number in range(sines.size):
        s = sines[number]
        point = nearest_point(s)
        square = 1.0 - s * s
        slip, slip_low = evaluated(point, SLIP, s - point / STEPS)
        steering, steering_low = evaluated(point, STEERING, s - point / STEPS)
        tangent, tangent_low, cosine = tangent_pair(s)
        a = c_asin(s)
        lack = (slip - a) + slip_low
        results[number, 0], errors[number, 0] = a, lack
        t = c_tan(a)
        results[number, 1], errors[number, 1] = t, (tangent - t) + (tangent_low - lack / square)
        d = c_atan(2.0 * t)
        lack = (steering - d) + (steering_low + ((t - tangent) - tangent_low) * 2.0 * square / (1.0 + 3.0 * s * s))
        results[number, 2], errors[number, 2] = d, lack
        double = c_tan(d)
        results[number, 3], errors[number, 3] = double, (2.0 * t - double) - lack * (1.0 + 4.0 * tangent * tangent)
        b = c_atan(0.5 * double)
        lack = (slip - b) + (slip_low + ((0.5 * double - tangent) - tangent_low) * square)
        results[number, 4], errors[number, 4] = b, lack
        results[number, 5] = c_sin(b)
        errors[number, 5] = (s - results[number, 5]) - ((slip - b) + slip_low) * cosine
        for function in range(6):
            assumed[number, function] = TABLE[point, SHARES + function] * results[number, function]


def measured(sines: Floats) -> tuple[Floats, Floats]:
    """[N, 6] errors of the C library in ulp, besides the rounding, and those that are assumed."""
    results, errors, assumed = np.zeros((3, len(sines), len(FUNCTIONS)))
    measure(sines, results, errors, assumed)
    ulp: NDArray[np.float64] = np.spacing(results)
    return np.abs(errors) / ulp - 0.5, assumed / ulp


if __name__ == "__main__":
    SINES = int(sys.argv[1]) if len(sys.argv) > 1 else 3_000_000
    sys.stdout.write(f"{'sine':<16}" + "".join(f"{name:>10}" for name in FUNCTIONS) + "\n")
    for low, high in itertools.pairwise(EDGES):
        worst = measured(np.random.default_rng(0).uniform(low, high, SINES))[0].max(0)
        sys.stdout.write(f"{low:<8g}{high:<8g}" + "".join(f"{error:10.4f}" for error in worst) + "\n")
