"""Normal numbers that are functions of a number and a place: compiled loops.

The bits are those of SplitMix64 (Steele, Lea and Flood 2014, "Fast Splittable Pseudorandom Number Generators"), started at the
number; two halves of each make two normal numbers (Box and Muller 1958). Nothing is contracted, so all processors agree.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, inner

BLOCK = 64
"""Points whose bits are drawn before they are made into normal numbers."""
GOLDEN, FIRST, SECOND = (np.uint64(value) for value in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))
LN2, HALF_PI = np.float32(0.6931471805599453), np.float32(1.5707963267948966)
ONE, TWO = np.float32(1), np.float32(2)
PER_HALF, PER_ROUND = np.float32(2.0**-31), np.float32(2.0**-32)


@inner
def mixed(value: np.uint64) -> np.uint64:
    """The mixing function of SplitMix64."""
    value = (value ^ (value >> np.uint64(30))) * FIRST
    value = (value ^ (value >> np.uint64(27))) * SECOND
    return value ^ (value >> np.uint64(31))


@inner
def _log(mantissa: np.float32, exponent: np.int32) -> np.float32:
    """ln of a float of mantissa 1 to 2, by the series of artanh around 1: to 1e-7 of itself or of 1."""
    large = mantissa > np.float32(1.4142135)
    mantissa = mantissa * np.float32(0.5) if large else mantissa
    whole = np.float32(exponent + np.int32(1)) if large else np.float32(exponent)
    z = (mantissa - ONE) / (mantissa + ONE)
    s = z * z
    series = ONE + s * (np.float32(1 / 3) + s * (np.float32(1 / 5) + s * (np.float32(1 / 7) + s * np.float32(1 / 9))))
    return whole * LN2 + TWO * z * series


@inner
def _sine(x: np.float32) -> np.float32:
    """Of -pi / 2 to pi / 2, by its series."""
    s = x * x
    series = np.float32(1 / 362880) - s * (np.float32(1 / 39916800) - s * np.float32(1 / 6227020800))
    return x * (ONE - s * (np.float32(1 / 6) - s * (np.float32(1 / 120) - s * (np.float32(1 / 5040) - s * series))))


@inner
def _cosine(x: np.float32) -> np.float32:
    """Of -pi / 2 to pi / 2, by its series."""
    s = x * x
    series = np.float32(1 / 40320) - s * (np.float32(1 / 3628800) - s * np.float32(1 / 479001600))
    return ONE - s * (np.float32(1 / 2) - s * (np.float32(1 / 24) - s * (np.float32(1 / 720) - s * series)))


@entry_point
def normal(numbers: NDArray[np.uint64], values: NDArray[Any]) -> None:
    """Standard normal numbers for points: row n of `values` is a function of number n alone.

    Args:
        numbers: [N].
        values: float32 [N, 2 * P], filled.
    """
    pairs = values.shape[1] // 2
    lengths, turns = np.empty(BLOCK * pairs, np.float32), np.empty(BLOCK * pairs, np.float32)
    bits = lengths.view(np.int32)
    for start in range(0, len(numbers), BLOCK):
        count = min(BLOCK, len(numbers) - start)
        for n in range(count):
            number = numbers[start + n]
            for pair in range(pairs):
                drawn = mixed(number + np.uint64(pair + 1) * GOLDEN)
                # Never 0, whose logarithm is infinite.
                lengths[n * pairs + pair] = (np.float32(np.uint32(drawn >> np.uint64(32))) + ONE) * PER_ROUND
                turns[n * pairs + pair] = np.float32(np.int32(np.uint32(drawn))) * PER_HALF
        for at in range(count * pairs):
            exponent = (bits[at] >> np.int32(23)) - np.int32(127)
            bits[at] = (bits[at] & np.int32(0x007FFFFF)) | np.int32(0x3F800000)
            square = -TWO * _log(lengths[at], exponent)
            lengths[at] = np.sqrt(square if square > 0 else np.float32(0))
        for n in range(count):
            for pair in range(pairs):
                length, half = lengths[n * pairs + pair], turns[n * pairs + pair] * HALF_PI
                s, c = _sine(half), _cosine(half)
                values[start + n, pair] = length * (c * c - s * s)
                values[start + n, pairs + pair] = length * (TWO * s * c)


@entry_point
def numbered(
    keys: NDArray[np.uint64], counts: NDArray[np.uint64], rows: NDArray[np.int64], found: NDArray[np.uint64]
) -> None:
    """Fill `found`, [copies, R], with numbers for copies of the episodes `rows`, of which `counts` [B] were made before.

    It counts them. A row that occurs several times gets a number for each time.
    """
    for copy in range(len(found)):
        for n in range(len(rows)):
            row = rows[n]
            counts[row] += np.uint64(1)
            found[copy, n] = mixed(mixed(keys[row] + counts[row] * GOLDEN) + keys[row])
