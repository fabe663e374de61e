"""Chooses the strongest of several attacks in each cell, on other scenarios than it is reported on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavbench.statistics.estimates import Array

FOLDS = 5
"""Parts of the scenarios. In each, the attack counts that is the strongest in the others."""
TIE = 1e-9
"""Means that differ by no more are equal: the order of a sum changes its last digits."""


def strongest_of(scores: Array) -> Array:
    """[A, C, E] how much each attack counts in each cell and scenario: 1 for the strongest, equal parts of 1 for equals.

    The strongest has the lowest mean over runs and the other folds' scenarios of the cell. Of attacks with equal means, such as
    0, the one with the lowest mean over all cells that they have in common counts, on the same scenarios. What is equal even
    then counts in equal parts. So neither the order of the attacks nor that of anything else changes a number.

    Args:
        scores: [A, R, C, E] of A attacks, R runs, C cells and E scenarios; NaN in the cells that an attack does not have.
    """
    totals = scores.sum(1)
    count = scores.shape[-1]
    fold = np.arange(count) % min(FOLDS, count)
    others = (fold[:, None] != fold).astype(float) if count > 1 else np.ones((1, 1))
    known = ~np.isnan(totals[..., 0])
    means = np.nan_to_num(totals) @ others / others.sum(0)
    means[~known] = np.inf
    equal = means <= means.min(0) + TIE
    for place in np.unique(fold):
        first, same = int(np.flatnonzero(fold == place)[0]), fold == place
        equal[:, :, same] = _told_apart(equal[:, :, first], means[:, :, first], known)[..., None]
    return np.asarray(equal / equal.sum(0))


def _told_apart(equal: NDArray[np.bool_], means: Array, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[A, C] of the attacks that are equal in a cell, those with the lowest mean over all cells that they have in common.

    Args:
        equal: [A, C] the attacks with the lowest mean of a cell.
        means: [A, C] their means.
        known: [A, C] the cells that each attack has.
    """
    found = equal.copy()
    for place in np.flatnonzero(equal.sum(0) > 1):
        attacks = np.flatnonzero(equal[:, place])
        overall = means[np.ix_(attacks, np.flatnonzero(known[attacks].all(0)))].mean(1)
        found[attacks, place] = overall <= overall.min() + TIE
    return found


def under(weights: Array, values: Array) -> Array:
    """[R, C, E] a measurement under the attacks that count; the mean of those that count in equal parts.

    Args:
        weights: [A, C, E], by `strongest_of`.
        values: [A, R, C, E]; may be NaN where the weight is 0.
    """
    parts = np.where(weights[:, None] > 0, weights[:, None] * values, 0.0)
    # A sum of sorted numbers is the same in every order of the attacks, to the last digit.
    return np.asarray(np.sort(parts, axis=0).sum(0) if (weights % 1).any() else parts.sum(0))
