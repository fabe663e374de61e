"""Intervals and comparisons that stay valid however often one looks: by betting (Waudby-Smith and Ramdas 2023).

Values lie in [0, 1] and are independent with one mean, such as the scores of fixed policies on scenario after scenario. Who bets
on whether a value is above or below m cannot expect to win if m is the mean. By Ville's inequality, a wealth that starts at 1
reaches 1 / tail at any time with probability `tail` at most. So an m at which the wealth ever became that high is refuted.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavbench.statistics.estimates import CONFIDENCE, Array

STEP = 0.001
"""Distance of two means that are tested; intervals are a step wider at each end."""
MOST_OF_WEALTH = 0.9
"""Most of the wealth that is staked: 1 could lose all of it."""


def confidence_sequence(values: Array, *, width: float, most: int) -> tuple[Array, Array]:
    """Bounds of the mean after each value, which hold all together with 95 %: hedged capital, Theorem 3 of the paper.

    Bets may depend on earlier values in any way. These grow wealth fastest against a mean that is `width` away (the paper's
    aGRAPA, with `width` in the place of the unknown distance), or that `most` values can just tell from the truth, whichever
    is larger. Bounds only ever move inwards.

    Args:
        values: [..., n], each in [0, 1].
        width: half the width of the interval that is wanted.
        most: number of values after which one stops in any case.

    Returns:
        The lower and the upper bounds [..., n].
    """
    tail = 1 - CONFIDENCE
    variance = _before(values)[1]
    bet = np.maximum(width / (variance + width**2), np.sqrt(2 * math.log(2 / tail) / (variance * most)))[..., None]
    means = np.arange(STEP, 1, STEP)
    gain = values[..., None] - means
    above = np.log1p(np.minimum(bet, MOST_OF_WEALTH / means) * gain).cumsum(-2)
    below = np.log1p(-np.minimum(bet, MOST_OF_WEALTH / (1 - means)) * gain).cumsum(-2)
    # Half of the wealth bets on each side.
    refuted = np.maximum.accumulate(np.maximum(above, below) >= math.log(2 / tail), axis=-2)
    kept = ~refuted
    # If no mean is left, which happens with probability `tail` at most, the last bounds stay.
    last = np.minimum(np.arange(values.shape[-1]), np.maximum(kept.any(-1).sum(-1, keepdims=True) - 1, 0))
    low = means[kept.argmax(-1)] - STEP
    high = means[len(means) - 1 - kept[..., ::-1].argmax(-1)] + STEP
    return np.take_along_axis(low, last, -1), np.take_along_axis(high, last, -1)


def shown_higher(values: Array, tail: float) -> NDArray[np.bool_]:
    """[...] whether at some time the values [..., n] showed that their mean is above 1/2: true by chance with probability `tail`.

    The bets are the paper's aGRAPA: the mean of earlier values minus 1/2, over its square and their variance.
    """
    mean, variance = _before(values)
    lead = np.maximum(mean - 0.5, 0)
    bet = np.minimum(lead / (variance + lead**2), 2 * MOST_OF_WEALTH)
    wealth = np.log1p(bet * (values - 0.5)).cumsum(-1)
    return np.asarray((wealth >= math.log(1 / tail)).any(-1))


def _before(values: Array) -> tuple[Array, Array]:
    """Mean and variance of the values before each one, with a first value of 1/2 and a first square of 1/4."""
    count = np.arange(1, values.shape[-1] + 1)
    mean = (0.5 + values.cumsum(-1)) / (count + 1)
    variance = (0.25 + np.square(values - mean).cumsum(-1)) / (count + 1)
    shape = (*values.shape[:-1], 1)
    return (
        np.concatenate([np.full(shape, 0.5), mean[..., :-1]], -1),
        np.concatenate([np.full(shape, 0.25), variance[..., :-1]], -1),
    )
