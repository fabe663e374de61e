"""The boxes of shown observations as one compiled loop, with the slope of each bound in the value behind it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cavbench.compiled import entry_point
from cavbench.driving.intervals.kernels import Floats


class Set(NamedTuple):
    """An assumed perturbation set; float32, arrays [F - 1].

    Args:
        half, centre: half the range of each feature, and its middle.
        reach: of the norm `linf`, the size of the set; of `relative`, the floor. 0 for a feature that no attack can change.
        larger, smaller: divisors of the norm `relative`; 1 for `linf`, and for a feature that no attack can change.
        noise: by how much the sensor may be wrong about other cars besides.
    """

    half: Floats
    centre: Floats
    reach: Floats
    larger: Floats
    smaller: Floats
    noise: Floats


@entry_point
def boxes(shown: Floats, of: Set, low: Floats, high: Floats, slopes: Floats) -> None:
    """The bounds of the true values behind the shown ones; fills `low`, `high` and `slopes`.

    Args:
        shown: observations [N, V, F].
        of: the set.
        low, high: the bounds [N, V, F - 1]; infinite where the sensor's range ends.
        slopes: how both bounds change with the shown value [2, N, V, F - 1]; with N = 0 they are left out.
    """
    inf, sloped = np.float32(np.inf), slopes.shape[1] > 0
    almost = np.float32(1 - 1e-5)
    for n in range(shown.shape[0]):
        for row in range(shown.shape[1]):
            for f in range(len(of.half)):
                half, centre, reach = of.half[f], of.centre[f], of.reach[f]
                value = shown[n, row, f + 1] * half + centre
                near, far = value / of.larger[f], value / of.smaller[f]
                down, up = min(near, far), max(near, far)
                below, above = value - reach, value + reach
                # A comparison with NaN is false, so NaN stays.
                bottom = down if down < below else below
                top = up if up > above else above
                noise = of.noise[f] if row > 0 else np.float32(0)
                lower, upper, end = bottom - noise, top + noise, half * almost
                open_below, open_above = lower - centre <= -end, upper - centre >= end
                low[n, row, f] = -inf if open_below else lower
                high[n, row, f] = inf if open_above else upper
                if sloped:
                    least, most = np.float32(1), np.float32(1)
                    if down < below:
                        least = np.float32(1) / (of.larger[f] if near < far else of.smaller[f])
                    if up > above:
                        most = np.float32(1) / (of.larger[f] if near > far else of.smaller[f])
                    slopes[0, n, row, f] = np.float32(0) if open_below else least * half
                    slopes[1, n, row, f] = np.float32(0) if open_above else most * half
