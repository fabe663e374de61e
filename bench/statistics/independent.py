"""The difference of two scores on the same scenarios, for victims that were trained apart."""

from __future__ import annotations

import math

import numpy as np

from cavbench.statistics.estimates import Array, Interval, margin_of, mean_squares, t_quantile

UNSEEN = 0.25
"""Intraclass correlation of trainings that the scores of one training are taken to have: about the largest of the published
victims (`ddpg` + `advtrain`: a standard deviation of .27 at .4)."""


def independent(
    first: Array, second: Array, *, trained: tuple[bool, bool] = (True, True), chosen: tuple[float, float] = (0.0, 0.0)
) -> Interval:
    """Mean of `first` minus mean of `second`, with a 95 % interval for other trainings of each and other scenarios of both.

    Trainings of the two sides have nothing in common, scenarios are the same. Each side that was trained several times adds its
    variance between trainings, the side of fewer trainings at least that of both together: a few may be all alike by chance. What
    the two sides vary with the scenario is paired.

    One training does not show how much trainings differ. That is taken from the other side, where this has enough trainings: as
    if all were trainings of one method, the hypothesis that the interval is to refute. So with six or more trainings on the other
    side it is the interval of one more of them, with a quantile that counts this one in (q = (n - 1) t^2 / (n - t^2), t of n
    degrees of freedom). Where that is wider, or there are fewer, the variance between trainings is `UNSEEN` m (1 - m), of the
    mean m of both sides: the largest that can be expected of a share.

    Args:
        first, second: [R_1, C, E] and [R_2, C, E], trainings x cells x scenario seeds, in [0, 1]; the same cells and scenarios.
        trained: whether each side is one of many possible trainings. A driver that does not learn, with one run, has no others.
        chosen: by how much the choice of the strongest attack may have missed, of each side in the mean over its runs.

    Raises:
        ValueError: if cells or scenarios differ.
    """
    if first.shape[1:] != second.shape[1:]:
        raise ValueError(f"the two sides differ in cells or scenarios: {first.shape[1:]} and {second.shape[1:]}")
    sides = [first.mean(1), second.mean(1)]
    ends = [float(side.mean()) for side in sides]
    unseen, parts = _of_trainings(sides, ends, trained)
    scenarios = first.shape[2]
    if scenarios > 1:
        paired = float((sides[0].mean(0) - sides[1].mean(0)).var(ddof=1))
        inside = sum(float(mean_squares(side)[2]) / len(side) for side in sides)
        parts.append((np.asarray(max(paired - inside, 0.0) / scenarios), scenarios - 1))
    estimate = ends[0] - ends[1]
    if not parts and unseen == 0:
        return Interval(estimate, math.nan, math.nan)
    choice = sum(left**2 / len(side) for left, side in zip(chosen, sides, strict=True))
    reach = math.sqrt(unseen + choice + (float(margin_of(parts)) ** 2 if parts else 0.0))
    return Interval(estimate, estimate - reach, estimate + reach)


def _of_trainings(
    sides: list[Array], ends: list[float], trained: tuple[bool, bool]
) -> tuple[float, list[tuple[Array, int]]]:
    """The square of the margin that trainings which nobody saw make, and the parts of the variance that trainings show."""
    counts = [len(side) for side in sides]
    seen = [float(side.mean(1).var(ddof=1)) if len(side) > 1 else 0.0 for side in sides]
    alone = [count == 1 and able for count, able in zip(counts, trained, strict=True)]
    if not any(alone):
        degrees = [count - 1 for count in counts]
        pooled = sum(spread * df for spread, df in zip(seen, degrees, strict=True)) / max(sum(degrees), 1)
        few = min(counts) if 1 < min(counts) < max(counts) else 0
        parts = []
        for spread, count, df in zip(seen, counts, degrees, strict=True):
            if count == few and pooled > spread:
                spread, df = pooled, sum(degrees)
            if count > 1:
                parts.append((np.asarray(spread / count), df))
        return 0.0, parts
    several = max(counts)
    # Each side's one training, and the mean of the other side's.
    share = 1 + 1 / several if several > 1 else float(sum(alone))
    middle = sum(ends) / 2
    widest = float(t_quantile(math.inf)) ** 2 * UNSEEN * max(middle * (1 - middle), 0.0)
    if several == 1:
        return share * widest, []
    square = float(t_quantile(several)) ** 2
    of_other = max(seen) * (several - 1) * square / (several - square) if several > square else math.inf
    return share * min(widest, of_other), []
