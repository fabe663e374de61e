"""The angles of steering as the C library rounds them, most of them without calling it.

highway-env's angles come from the C library. Its functions are wrong by little more than half a unit in the last place (ulp).
So a value with ten more bits decides which number they return, unless it lies close to the middle of two numbers. There the C
library is asked. "Assumed" is what it may be wrong by besides the rounding, in ulp. "Stated" is what glibc's sources say
(comments in sysdeps/ieee754/dbl-64; older versions round correctly). "Seen" is the worst of 3 million arguments in each of 22
intervals with glibc 2.36, by `python -m tests.envs.roads.angle_errors`:

| function | stated | seen | assumed |
|---|---|---|---|
| `asin` | 0.013 below 0.125, 0.024 to 0.5, 0.005 to 0.75 | 0.0101, 0.0153, 0.0038 | 0.015 to 0.124, 0.025, halved from 0.25 |
| `tan` | 0.004 to 0.061, 0.1 to 0.787, 0.12 beyond | 0.0025, 0.068, 0.011 | 0.006 to 0.06, 0.1, halved from 0.125, last 0.02 |
| `atan` | 0.011 below 1/16, 0.06 to 1, 0.003 beyond | 0.0077, 0.0215, 0.0036 | 0.012 to 0.062, 0.06, halved from 0.125 |
| `sin` | 0.001 below 0.126, 0.018 beyond | 0.0077, 0.0155 | 0.012 to 0.124, 0.02, halved from 0.25 |

Limits are those of results. "Halved" is at that result and at each later power of two: there glibc adds a small correction to a
number of a table, and the error is that of the correction, so in ulp of the result it falls. That is seen, but not stated. A C
library that is wrong by more is not always followed to the last bit.

Values are pairs: a number and a small correction, which together have at least 63 bits. They come from Taylor polynomials about
the points of a table, whose constant and linear terms are pairs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import types
from numpy.typing import NDArray

from cavbench.compiled import borrowing, fused, inlined

_signature = types.float64(types.float64)
c_sin, c_asin = types.ExternalFunction("sin", _signature), types.ExternalFunction("asin", _signature)
c_tan, c_atan = types.ExternalFunction("tan", _signature), types.ExternalFunction("atan", _signature)
"""The C library's functions. LLVM would compute `math.sin` first and then choose, because it has no side effects."""

ASIN, TAN = (0.015, 0.124, 0.025, 0.25), (0.006, 0.06, 0.1, 0.125)
ATAN, SIN = (0.012, 0.062, 0.06, 0.125), (0.012, 0.124, 0.02, 0.25)
"""Assumed errors: below a result, from there on, and from which result on they are halved."""
STEEP_TAN = 0.98, 0.02
"""From this result on the assumed error of `tan` is at least so large."""

BITS = 160
"""After the point, of the integers from which the table is computed."""
STEPS, LAST = 128, 91
"""Points of the table per unit of the sine, and its last one: up to 0.714."""
DEGREE, ORDER = 10, 32
"""Of the polynomials, and of the series from which a point of the table follows from the one before."""
SLIP, STEERING, SHARES = 0, DEGREE + 3, 2 * (DEGREE + 3)
"""First columns of the two functions, and of the shares of doubt of the six that `steered` rounds."""
TINY = 1e-100
"""The corrections of smaller angles would be denormal."""


def _share(assumed: tuple[float, float, float, float], low: float, high: float) -> float:
    """The largest assumed error of results from `low` to `high`, as a share of the result."""
    below, edge, beyond, halved = assumed
    errors = [below if low < edge else 0.0]
    if high >= edge:
        power = 2.0 ** math.floor(math.log2(max(low, edge)))
        errors.append(beyond * min(1.0, halved / 2 / power))
    if assumed is TAN and high >= STEEP_TAN[0]:
        errors.append(STEEP_TAN[1])
    # The share of an ulp is the largest in a power of two.
    ulp = math.ulp(low) / low if low > 0.0 and math.ulp(low) == math.ulp(high) else 2.0**-52
    return max(errors) * ulp


def _shares(point: int) -> list[float]:
    """The shares of doubt of the six functions in `steered` about a point."""
    sines = max(point - 0.5, 0.0) / STEPS, (point + 0.502) / STEPS
    slips = [math.asin(sine) for sine in sines]
    tangents = [math.tan(slip) for slip in slips]
    doubles = [2.0 * tangent for tangent in tangents]
    steerings = [math.atan(double) for double in doubles]
    pairs = (ASIN, slips), (TAN, tangents), (ATAN, steerings), (TAN, doubles), (ATAN, slips), (SIN, sines)
    return [_share(assumed, *results) for assumed, results in pairs]


def _pair(value: int) -> tuple[float, float]:
    """A number with `BITS` after the point, as a number and a correction."""
    high = value / 2**BITS
    return high, (value - int(math.ldexp(high, BITS))) / 2**BITS


def _row(series: Sequence[int]) -> list[float]:
    """The polynomial of a series: two pairs and numbers."""
    return [*_pair(series[0]), *_pair(series[1]), *(value / 2**BITS for value in series[2 : DEGREE + 1])]


def _step(series: Sequence[int]) -> int:
    """By how much a function grows to the next point."""
    total = 0
    for coefficient in reversed(series[1:]):
        total = (total + coefficient) // STEPS
    return total


def _table() -> NDArray[np.float64]:
    """[K, 32] polynomials of two functions of a sine s about k / `STEPS`, and shares of doubt.

    The functions are asin(s) and atan(2 tan(asin(s))). The derivative of the first is w = (1 - s^2)^(-1/2), that of the second
    2 w / (1 + 3 s^2), so both series follow from that of w.
    """
    one, slip, steering, rows = 1 << BITS, 0, 0, []
    for point in range(LAST + 1):
        s = (point << BITS) // STEPS
        square = (s * s) >> BITS
        w = [0, math.isqrt(one**3 // (one - square))]
        rate = [0, 2 * w[1] * one // (one + 3 * square)]
        for n in range(1, ORDER):
            w.append((s * (2 * n - 1) * w[n] + (n - 1) * one * w[n - 1]) // (n * (one - square)))
            rate.append((2 * w[n + 1] * one - 6 * s * rate[n] - 3 * one * rate[n - 1]) // (one + 3 * square))
        slips = [slip, *(value // n for n, value in enumerate(w[1:], 1))]
        steerings = [steering, *(value // n for n, value in enumerate(rate[1:], 1))]
        rows.append(_row(slips) + _row(steerings) + _shares(point))
        slip, steering = slip + _step(slips), steering + _step(steerings)
    return np.array(rows)


TABLE = _table()


@inlined
def nearest_point(sine: float) -> int:
    """The point of the table next to a sine, which is more than half of that of point 1: their difference is exact."""
    return int(sine * STEPS + 0.499)


@inlined
def evaluated(point: int, first: int, off: float) -> tuple[float, float]:
    """The pair of a function, `off` from a point, from the columns of the table that begin with `first`."""
    linear = TABLE[point, first + 2]
    step = off * linear
    error = fused(off, linear, -step) + fused(off, TABLE[point, first + 3], TABLE[point, first + 1])
    # The terms two by two, so that the processor need not wait for one after the other.
    square = off * off
    two = fused(off, TABLE[point, first + 5], TABLE[point, first + 4])
    four = fused(off, TABLE[point, first + 7], TABLE[point, first + 6])
    six = fused(off, TABLE[point, first + 9], TABLE[point, first + 8])
    eight = fused(off, TABLE[point, first + 11], TABLE[point, first + 10])
    fourth = square * square
    curve = fused(fourth, fused(square, fused(square, TABLE[point, first + 12], eight), six), fused(square, four, two))
    constant = TABLE[point, first]
    total = constant + step
    # The constant is 0 or larger than the step, so nothing is lost.
    return total, ((constant - total) + step) + fused(square, curve, error)


@inlined
def is_decided(high: float, low: float, share: float) -> bool:
    """Whether a pair that is too small or too large by a share is rounded to the same number, the one of the C library."""
    doubt = high * share
    return high + (low - doubt) == high + (low + doubt)


@inlined
def tangent_pair(sine: float) -> tuple[float, float, float]:
    """The pair of sine / cosine, by one Newton step for the root and one for the quotient; and the cosine."""
    square = 1.0 - sine * sine
    rest = fused(-sine, sine, 1.0 - square)
    cosine = math.sqrt(square)
    inverse = 1.0 / cosine
    cosine_low = 0.5 * inverse * (fused(-cosine, cosine, square) + rest)
    tangent = sine * inverse
    return tangent, inverse * (fused(-tangent, cosine, sine) - tangent * cosine_low), cosine


@borrowing
def steered(sine: float) -> tuple[float, float, float]:
    """The angles of a bicycle whose slip angle shall have a sine in [-0.71, 0.71], with the C library's bits.

    Returns:
        The steering angle d = atan(2 tan(asin(sine))) in rad, the slip angle b = atan(tan(d) / 2) in rad, and sin(b).

    Each of the six functions is rounded, so b is not quite asin(sine). What a rounding is worth in the next result is a
    first-order term; the second one is below 2^-100.
    """
    s = abs(sine)
    if not s > TINY:
        d = c_atan(2.0 * c_tan(c_asin(sine)))
        b = c_atan(0.5 * c_tan(d))
        return d, b, c_sin(b)
    point = nearest_point(s)
    off = s - point / STEPS
    tangent, tangent_low, cosine = tangent_pair(s)
    slip, slip_low = evaluated(point, SLIP, off)
    steering, steering_low = evaluated(point, STEERING, off)
    # Derivatives: 1 / cos^2(slip), and 1 / (1 + 4 tan^2(slip)) = cos^2(slip) / (1 + 3 sin^2(slip)).
    square = 1.0 - s * s
    slope, double_slope = 1.0 + tangent * tangent, 0.5 + 2.0 * tangent * tangent
    rate = 2.0 * square / (1.0 + 3.0 * s * s)
    # What is left of each rounding, times the next derivative, is added to the next correction.
    a = slip + slip_low
    if not is_decided(slip, slip_low, TABLE[point, SHARES]):
        a = c_asin(s)
    low = fused(a - slip, slope, fused(-slip_low, slope, tangent_low))
    t = tangent + low
    if not is_decided(tangent, low, TABLE[point, SHARES + 1]):
        t = c_tan(a)
    low = fused(t - tangent, rate, fused(-tangent_low, rate, steering_low))
    d = steering + low
    if not is_decided(steering, low, TABLE[point, SHARES + 2]):
        d = c_atan(2.0 * t)
    low = ((d - steering) - low) * double_slope
    u = t + low
    if not is_decided(t, low, TABLE[point, SHARES + 3]):
        u = 0.5 * c_tan(d)
    low = fused(u - tangent, square, fused(-tangent_low, square, slip_low))
    b = slip + low
    if not is_decided(slip, low, TABLE[point, SHARES + 4]):
        b = c_atan(u)
    low = ((b - slip) - slip_low) * cosine
    sine_b = s + low
    if not is_decided(s, low, TABLE[point, SHARES + 5]):
        sine_b = c_sin(b)
    return math.copysign(d, sine), math.copysign(b, sine), math.copysign(sine_b, sine)
