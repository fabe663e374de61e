#!/usr/bin/env bash
# One guesses: in a function compiled by numba, `x.mean()` of a float32 array is numpy's, and a loop with `total = 0.0` is the coarser one.
# What happens: numba's `sum`, `mean` and `var` add in float32, one after the other, where numpy adds pairwise: 9 % off for ten million
# values. The loop is in float64, as `0.0` is, and exact. So is every product of a float32 scalar and a literal.
# Versions: numba 0.68.1, numpy 2.4.6. Source: means of rewards that changed when a function was compiled.
source "$(dirname "$0")/fresh.sh"
fresh numba==0.68.1 numpy==2.4.6
see <<'P'
import numba
import numpy as np


@numba.njit
def loop(values):
    total = 0.0
    for value in values:
        total += value
    return total / len(values)


tenths = np.full(10_000_000, 0.1, np.float32)
mean, variance = (numba.njit(function)(tenths) for function in (lambda x: x.mean(), lambda x: x.var()))
by_loop, numpys, product = loop(tenths), float(tenths.mean()), numba.njit(lambda x: x[0] * 0.5)
kind = numba.typeof(product(tenths))
print(
    f"numba {numba.__version__}: mean of ten million 0.1 in float32: numpy {numpys:.4f}, compiled {mean:.4f}, compiled loop {by_loop:.4f}; "
    f"float32 times 0.5 is {kind}, numpy's {(tenths[0] * 0.5).dtype}"
)
off = abs(mean - 0.1) > 0.005 and abs(numpys - 0.1) < 1e-6 and abs(by_loop - 0.1) < 1e-6
raise SystemExit(not (off and kind == numba.float64))
P
