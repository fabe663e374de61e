"""Powers as the C library rounds them, most of them without calling it."""

from __future__ import annotations

from numba import types

from cavbench.compiled import borrowing, fused

called = types.ExternalFunction("pow", types.float64(types.float64, types.float64))
"""The C library's function. LLVM would compute `math.pow` first and then choose, because it has no side effects."""

DOUBT = 0.015 * 2.0**-52
"""Share of a number: more than the C library is wrong by before it rounds, which here is below 0.012 units in the last place in
glibc since 2.28 (sysdeps/ieee754/dbl-64/e_pow.c)."""
SMALLEST = 1e-20
"""The error is so small for powers between this and its inverse."""


@borrowing
def fourth_power(base: float) -> float:
    """`base` ** 4 with the bits of the C library's `pow`, which is called only where twice the digits leave a doubt."""
    square = base * base
    square_error = fused(base, base, -square)
    fourth = square * square
    error = fused(square, square, -fourth) + 2.0 * square * square_error
    doubt = fourth * DOUBT
    low, high = fourth + (error - doubt), fourth + (error + doubt)
    if low == high and SMALLEST < fourth < 1 / SMALLEST:
        return low
    return called(base, 4.0)


@borrowing
def power(base: float, exponent: float) -> float:
    """`base` ** `exponent`."""
    if base == 1.0:
        return 1.0
    if exponent == 4.0:
        return fourth_power(base)
    return called(base, exponent)
