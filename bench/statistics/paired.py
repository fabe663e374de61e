"""Paired differences of scores and whether they are more than chance, of one or of many at once.

Pure functions on arrays. The intervals are those of `cavbench.statistics.estimates`: the training and the scenario are crossed
random factors, and both sides meet the same ones.
"""

from __future__ import annotations

import math

import numpy as np

from cavbench.statistics.estimates import Array, components

LEVEL = 0.05
"""The probability that any of several differences is called significant where there is none."""
EQUAL = 1e-9
"""Differences that differ by no more are equal."""
STEPS = 60
"""Halvings of an interval."""


def p_values(differences: Array) -> Array:
    """The two-sided p-value of each mean difference: 1 - the confidence of the widest interval that leaves out 0.

    Differences that are all equal have no variance, which says nothing if they are few: there it is that of a sign test.

    Args:
        differences: [..., R, E], training seeds x scenarios, finite: one side minus the other.

    Returns:
        [...]; 1 with one training seed and one scenario.
    """
    runs, scenarios = differences.shape[-2:]
    estimates, parts = np.abs(differences.mean((-2, -1))), components(differences)
    if max(runs, scenarios) == 1:
        return np.ones_like(estimates)
    # The margin grows as the tail shrinks: the tail at which both are equal is found by halving its logarithm.
    low, high = np.full(estimates.shape, -200.0), np.full(estimates.shape, math.log(0.5))
    for _ in range(STEPS):
        middle = (low + high) / 2
        inside = parts.margin(np.exp(middle)) > estimates
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    equal = np.ptp(differences, axis=(-2, -1)) <= EQUAL
    found = np.where(equal, 2.0 ** (1 - max(runs, scenarios)), np.minimum(2 * np.exp(high), 1.0))
    return np.asarray(np.where(estimates > 0, found, 1.0))


def holm(p: Array) -> Array:
    """The p-values adjusted for their number: with those below `LEVEL` called significant, the chance of any error is `LEVEL`.

    Holm (1979), "A simple sequentially rejective multiple test procedure". Nothing is assumed about how the tests depend.

    Args:
        p: [N] p-values.
    """
    order = np.argsort(p, kind="stable")
    adjusted = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1.0)
    found = np.empty_like(adjusted)
    found[order] = adjusted
    return found
