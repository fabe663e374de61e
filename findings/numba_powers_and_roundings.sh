#!/usr/bin/env bash
# One guesses: scalars in a compiled function of numba have Python's values, but for overflow: `2 ** -1` is 0.5 (or raises, as in numpy),
# and round(2.675, 2) is 2.67, as 2.675 is 2.67499... in binary.
# What happens: a variable integer to a variable power of -1 is 0, without a word, and the rounding is 2.68.
# Versions: numba 0.68.1. Source: a discount factor of 10 ** -k that became 0 in a compiled function.
source "$(dirname "$0")/fresh.sh"
fresh numba==0.68.1 numpy==2.4.6
see <<'P'
import numba


def power(base, exponent):
    return base**exponent


def rounded(value):
    return round(value, 2)


found = {
    "2 ** -1": (power(2, -1), numba.njit(power)(2, -1)),
    "10 ** -2": (power(10, -2), numba.njit(power)(10, -2)),
    "round(2.675, 2)": (rounded(2.675), numba.njit(rounded)(2.675)),
}
print(f"numba {numba.__version__}: in Python and compiled: {found}")
raise SystemExit(found != {"2 ** -1": (0.5, 0), "10 ** -2": (0.01, 0), "round(2.675, 2)": (2.67, 2.68)})
P
