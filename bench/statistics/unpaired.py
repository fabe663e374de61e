"""The difference of two scores on different scenarios, for the same training seeds and cells, and what it can find."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cavbench.statistics.estimates import CONFIDENCE, Array, Interval, t_quantile

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
    sides = _sides(first, second)
    estimate, error = sides.estimate, sides.error()
    if error == 0:
        return Interval(estimate, estimate, estimate)
    reach = error * sides.quantile(comparisons)
    return Interval(estimate, estimate - reach, estimate + reach)


POWER = 0.8
"""How often a comparison of enough scenarios finds what there is."""
NOTABLE = 0.05
"""An inflation of a score that an audit should find."""
MOST_SCENARIOS = 10**7


@dataclass(frozen=True)
class Finds:
    """What a comparison of this size finds: how often its lower bound lies above 0 where the first side is better.

    Args:
        smallest: the smallest difference that is found in `POWER` of draws.
        chance: how often a difference of `NOTABLE` is found.
        scenarios: number of scenarios a side with which that is found in `POWER` of draws.
    """

    smallest: float
    chance: float
    scenarios: int


def finds(first: Array, second: Array, *, comparisons: int = 1) -> Finds:
    """What `unpaired` finds with scores that vary as these do; arguments and errors as there.

    The test statistic of a true difference d has a noncentral t distribution with noncentrality d / standard error (Welch's
    degrees of freedom). The standard errors are those that were measured, so the figures are estimates, too.
    """
    sides = _sides(first, second)
    if sides.error() == 0:
        return Finds(0.0, 1.0, max(sides.sizes))
    return Finds(sides.smallest(comparisons), sides.chance(NOTABLE, comparisons), sides.enough(NOTABLE, comparisons))


@dataclass(frozen=True)
class _Sides:
    """Two samples of scenario means.

    Args:
        estimate: difference of their means.
        variances: of their scenarios.
        sizes: their numbers of scenarios.
    """

    estimate: float
    variances: tuple[float, float]
    sizes: tuple[int, int]

    def error(self) -> float:
        """Standard error of the difference."""
        return math.sqrt(sum(variance / size for variance, size in zip(self.variances, self.sizes, strict=True)))

    def freedom(self) -> float:
        """Welch's degrees of freedom."""
        parts = [(variance / size, size) for variance, size in zip(self.variances, self.sizes, strict=True)]
        return sum(part for part, _ in parts) ** 2 / sum(part**2 / (size - 1) for part, size in parts)

    def quantile(self, comparisons: int) -> float:
        """Standard errors from the estimate to a bound of the interval."""
        return float(t_quantile(self.freedom(), (1 - CONFIDENCE) / 2 / comparisons))

    def chance(self, difference: float, comparisons: int) -> float:
        """How often the lower bound lies above 0."""
        from scipy.special import nctdtr

        return 1 - float(nctdtr(self.freedom(), difference / self.error(), self.quantile(comparisons)))

    def smallest(self, comparisons: int) -> float:
        """The difference that is found in `POWER` of draws."""
        from scipy.special import nctdtrinc

        return self.error() * float(nctdtrinc(self.freedom(), 1 - POWER, self.quantile(comparisons)))

    def enough(self, difference: float, comparisons: int) -> int:
        """Scenarios a side with which a difference is found in `POWER` of draws."""
        low, high = ENOUGH_SCENARIOS - 1, ENOUGH_SCENARIOS
        while self._of(high).chance(difference, comparisons) < POWER and high < MOST_SCENARIOS:
            low, high = high, 2 * high
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if self._of(middle).chance(difference, comparisons) >= POWER else (middle, high)
        return high

    def _of(self, size: int) -> _Sides:
        return _Sides(self.estimate, self.variances, (size, size))


def _sides(first: Array, second: Array) -> _Sides:
    if first.shape[:2] != second.shape[:2]:
        raise ValueError(f"the two sides differ in training seeds or cells: {first.shape[:2]} and {second.shape[:2]}")
    if min(first.shape[2], second.shape[2]) < ENOUGH_SCENARIOS:
        raise ValueError(f"an unpaired difference needs at least {ENOUGH_SCENARIOS} scenarios a side")
    means = first.mean((0, 1)), second.mean((0, 1))
    one, other = (float(side.var(ddof=1)) for side in means)
    return _Sides(float(means[0].mean() - means[1].mean()), (one, other), (len(means[0]), len(means[1])))
