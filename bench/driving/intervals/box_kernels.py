"""The boxes of shown observations as compiled loops, with the slope of each bound in the value behind it."""

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


@entry_point
def narrow(shown: Floats, tracks: Floats, low: Floats, high: Floats, slopes: Floats) -> None:
    """The boxes of other cars, each intersected with the hull of all tracks that it may belong to, in place.

    Args:
        shown: observations [N, V, F].
        tracks: 1 for those that exist, else 0, their lower bounds and their upper ones, [N, K, 2 F - 1].
        low, high, slopes: as `boxes` filled them. The slope of a bound that is moved is 0.
    """
    features, sloped = low.shape[2], slopes.shape[1] > 0
    least, most = np.empty(features, np.float32), np.empty(features, np.float32)
    for n in range(len(low)):
        for box in range(1, low.shape[1]):
            # New cars appear where the sensor's range ends.
            if not (shown[n, box, 0] > 0 and np.isfinite(high[n, box, 0])):
                continue
            least[:], most[:] = np.inf, -np.inf
            fits_any = False
            for one in range(tracks.shape[1]):
                track = tracks[n, one]
                fits = track[0] > 0
                for f in range(features):
                    if not fits:
                        break
                    fits = low[n, box, f] <= track[1 + features + f] and track[1 + f] <= high[n, box, f]
                if fits:
                    fits_any = True
                    for f in range(features):
                        least[f] = min(least[f], track[1 + f])
                        most[f] = max(most[f], track[1 + features + f])
            for f in range(features):
                lower, upper = max(low[n, box, f], least[f]), min(high[n, box, f], most[f])
                if not (fits_any and lower <= upper):
                    continue
                if sloped and lower > low[n, box, f]:
                    slopes[0, n, box, f] = 0
                if sloped and upper < high[n, box, f]:
                    slopes[1, n, box, f] = 0
                low[n, box, f], high[n, box, f] = lower, upper


@entry_point
def boxes_backward(slopes: Floats, by_low: Floats, by_high: Floats, by_shown: Floats) -> None:
    """The gradient in the shown observations [N, V, F], filled, from those in the bounds [N, V, F - 1]."""
    for n in range(len(by_shown)):
        for row in range(by_shown.shape[1]):
            by_shown[n, row, 0] = 0
            for f in range(by_low.shape[2]):
                by_shown[n, row, f + 1] = (
                    by_low[n, row, f] * slopes[0, n, row, f] + by_high[n, row, f] * slopes[1, n, row, f]
                )
