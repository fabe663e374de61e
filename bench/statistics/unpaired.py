"""The difference of two scores on different scenarios, for the same training seeds and cells."""

from __future__ import annotations

import math

from bench.statistics.estimates import CONFIDENCE, Array, Interval, t_quantile

ENOUGH_SCENARIOS = 10
"""A side with fewer scenarios is no evidence: where scores hardly vary, its variance says too little."""


def unpaired(first: Array, second: Array, *, comparisons: int = 1) -> Interval:
    """Mean of `first` minus mean of `second`, with a Welch t interval over scenarios.

    Training seeds and cells are the same on both sides and are not resampled: the interval is about other scenarios for these
    policies. A scenario seed is one draw: its scores are averaged over training seeds and cells first, because they share
    traffic. With E_1 and E_2 such means of variance s_1^2 and s_2^2, the standard error is sqrt(s_1^2 / E_1 + s_2^2 / E_2), the
    degrees of freedom are those of Welch (1947, "The generalization of 'Student's' problem").

    Where both sides are alike, the lower bound lies above 0 in 2.5 % / `comparisons` of draws.

    Args:
        first, second: [R, C, E_1] and [R, C, E_2], training seeds x cells x scenario seeds, finite.
        comparisons: number of intervals of which none shall fail (Bonferroni); the interval is wider with more.

    Raises:
        ValueError: if training seeds or cells differ, or a side has fewer than `ENOUGH_SCENARIOS` scenarios.
    """
    if first.shape[:2] != second.shape[:2]:
        raise ValueError(f"the two sides differ in training seeds or cells: {first.shape[:2]} and {second.shape[:2]}")
    if min(first.shape[2], second.shape[2]) < ENOUGH_SCENARIOS:
        raise ValueError(f"an unpaired difference needs at least {ENOUGH_SCENARIOS} scenarios a side")
    means = first.mean((0, 1)), second.mean((0, 1))
    errors = [float(side.var(ddof=1)) / len(side) for side in means]
    estimate, error = float(means[0].mean() - means[1].mean()), math.sqrt(sum(errors))
    if error == 0:
        return Interval(estimate, estimate, estimate)
    freedom = sum(errors) ** 2 / sum(one**2 / (len(side) - 1) for one, side in zip(errors, means, strict=True))
    reach = error * float(t_quantile(freedom, (1 - CONFIDENCE) / 2 / comparisons))
    return Interval(estimate, estimate - reach, estimate + reach)
