"""Chooses the strongest of several attacks in each cell, on other scenarios than it is reported on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.statistics.estimates import Array

FOLDS = 5
"""Parts of the scenarios. In each, the attack counts that is the strongest in the others."""


def strongest_of(scores: Array) -> NDArray[np.int64]:
    """[C, E] the attack with the lowest mean over runs and the other folds' scenarios.

    Args:
        scores: [A, R, C, E] of A attacks, R runs, C cells and E scenarios; NaN in the cells that an attack does not have.
    """
    totals = scores.sum(1)
    count = scores.shape[-1]
    fold = np.arange(count) % min(FOLDS, count)
    others = (fold[:, None] != fold).astype(float) if count > 1 else np.ones((1, 1))
    means = np.where(np.isnan(totals), np.inf, np.nan_to_num(totals) @ others / others.sum(0))
    return np.asarray(means.argmin(0))
