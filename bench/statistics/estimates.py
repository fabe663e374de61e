"""Means with 95 % intervals over two crossed random factors: the training (runs) and the scenario.

Pure functions on arrays; `cavbench.statistics.episodes` says what the arrays mean. docs/statistics.md derives the intervals.
studies/interval_coverage.md has the table of their coverage (`python -m tests.leaderboard.simulated_studies`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CONFIDENCE = 0.95
_TAIL = (1 + CONFIDENCE) / 2
_Z2 = NormalDist().inv_cdf(_TAIL) ** 2
RARE, OF_RARE = 0.1, 0.2
"""Below `RARE`, a few trainings tell too little of how much trainings differ: those that crash may all be among the unseen ones.
There the intraclass correlation of trainings counts as at least `OF_RARE`, in proportion less towards `RARE`."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % confidence interval, in the unit of the measurement; the bounds are NaN if there is none."""

    estimate: float
    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high


@dataclass(frozen=True)
class Components:
    """The two parts of the variance of a mean over runs and scenarios, one entry for each mean.

    Args:
        training: the part that falls with the number of runs: mean square of the runs over the number of episodes.
        scenario: the part that falls with the number of scenarios, at least 0.
        runs: R, number of runs.
        scenarios: E, number of scenarios.
    """

    training: Array
    scenario: Array
    runs: int
    scenarios: int

    def margin(self, tail: Array | float = 1 - _TAIL) -> Array:
        """Half the width of the interval of each mean, of 95 % by default; NaN with one run and one scenario.

        Args:
            tail: the probability of each side that the interval leaves out; one for all means, or one for each.

        The square is the mean of two: Satterthwaite's (1946), a t-quantile with the degrees of freedom of the sum, which is too
        narrow if few runs make most of the variance; and the sum of the squared margins of the two parts (the modified large
        sample method of Graybill and Wang 1980), which is too wide if both are large. Each alone leaves 94 to 97 %.
        """
        own = max(self.runs - 1, 0), max(self.scenarios - 1, 0)
        if not any(own):
            return np.full_like(self.training, np.nan)
        return margin_of([(part, df) for part, df in zip((self.training, self.scenario), own, strict=True) if df], tail)


def margin_of(parts: Sequence[tuple[Array, int]], tail: Array | float = 1 - _TAIL) -> Array:
    """Half the width of the interval of a mean whose variance is a sum (`Components.margin`).

    Args:
        parts: each part of the variance with its degrees of freedom.
        tail: as there.
    """
    variance = np.asarray(sum(part for part, _ in parts))
    freedom = np.asarray(sum(np.square(part) / df for part, df in parts))
    effective = np.divide(np.square(variance), freedom, out=np.ones_like(variance), where=freedom > 0)
    joint = np.square(t_quantile(effective, tail)) * variance
    apart = sum(np.square(t_quantile(df, tail)) * part for part, df in parts)
    return np.asarray(np.sqrt((joint + apart) / 2))


def t_quantile(freedom: Array | float, tail: Array | float = 1 - _TAIL) -> Array:
    """The quantile of Student's t that is exceeded with probability `tail`."""
    from scipy.special import stdtrit

    # 1 - tail has no digits of a tail that is far out.
    return np.asarray(np.where(np.asarray(tail) > 1e-4, stdtrit(freedom, 1 - tail), -stdtrit(freedom, tail)))


def components(means: Array) -> Components:
    """The variance components of means over runs and scenarios, by the mean squares of a crossed design with two factors.

    Args:
        means: [..., R, E], finite.
    """
    runs, scenarios = means.shape[-2:]
    of_runs, of_scenarios, rest = mean_squares(means)
    episodes = runs * scenarios
    return Components(of_runs / episodes, np.maximum(of_scenarios - rest, 0.0) / episodes, runs, scenarios)


def mean_squares(means: Array) -> tuple[Array, Array, Array]:
    """The mean squares of the runs, of the scenarios and of the rest of means [..., R, E]; 0 for what there is one of."""
    runs, scenarios = means.shape[-2:]
    grand = means.mean((-2, -1), keepdims=True)
    by_run, by_scenario = means.mean(-1, keepdims=True), means.mean(-2, keepdims=True)
    of_runs = scenarios * np.square(by_run - grand).sum((-2, -1)) / max(runs - 1, 1)
    of_scenarios = runs * np.square(by_scenario - grand).sum((-2, -1)) / max(scenarios - 1, 1)
    rest = np.square(means - by_run - by_scenario + grand).sum((-2, -1)) / max((runs - 1) * (scenarios - 1), 1)
    return of_runs, of_scenarios, rest


def interval(scores: Array) -> Interval:
    """Mean over runs, tasks and scenarios, with a 95 % interval for other trainings and other scenarios.

    With one run the interval covers that policy alone; with one scenario it covers that scenario alone.

    Args:
        scores: [R, C, E], R runs (training seeds) x C tasks (cells) x E scenarios, finite. Runs are the same in all cells, and
            scenarios the same for all runs; those of one place E may be related between cells.

    Raises:
        ValueError: if `scores` is not three-dimensional, is empty, or holds a value that is not finite.
    """
    _check(scores)
    means = scores.mean(1)
    return _symmetric(float(means.mean()), float(components(means).margin()))


def share_interval(scores: Array) -> Interval:
    """`interval` for scores in [0, 1], such as rates: within [0, 1], and with a width where all scores are 0 or 1.

    Wilson's score interval (1927), with the variance of the mean in place of the binomial one. Near 0 it is wider than several
    runs say (`RARE`): a few trainings that hardly crash do not show that there are no others.

    Args:
        scores: [R, C, E], as in `interval`, in [0, 1].
    """
    _check(scores)
    means = scores.mean(1)
    return _wilson(float(means.mean()), float(components(means).margin()), scores.size, len(scores))


def task_intervals(scores: Array, *, share: bool) -> list[Interval]:
    """`interval`, or `share_interval`, for each task separately.

    Args:
        scores: [R, C, E], as in `interval`.
        share: whether the scores are in [0, 1].
    """
    _check(scores)
    means = np.moveaxis(scores, 1, 0)
    estimates, margins = means.mean((1, 2)).tolist(), components(means).margin().tolist()
    episodes, runs = means[0].size, len(scores)
    return [
        _wilson(estimate, margin, episodes, runs) if share else _symmetric(estimate, margin)
        for estimate, margin in zip(estimates, margins, strict=True)
    ]


def _symmetric(estimate: float, margin: float) -> Interval:
    return Interval(estimate, estimate - margin, estimate + margin)


def _wilson(share: float, margin: float, episodes: int, runs: int) -> Interval:
    """Wilson's interval of a share whose symmetric interval is share +- margin; of independent episodes if all are 0 or 1."""
    if math.isnan(margin):
        return Interval(share, np.nan, np.nan)
    share = min(max(share, 0.0), 1.0)
    spread = share * (1 - share)
    ratio = margin**2 / spread if spread > 0 else _Z2 / episodes
    if runs > 1:
        ratio = max(ratio, _Z2 / runs * OF_RARE * max(0.0, 1 - share / RARE))
    centre = (share + ratio / 2) / (1 + ratio)
    half = math.sqrt(ratio * spread + ratio**2 / 4) / (1 + ratio)
    return Interval(share, min(max(centre - half, 0.0), share), max(min(centre + half, 1.0), share))


def _check(scores: Array) -> None:
    if scores.ndim != 3 or not scores.size:
        raise ValueError(f"scores must be runs x tasks x episodes and not empty, got shape {scores.shape}")
    if not np.isfinite(scores).all():
        raise ValueError("scores must be finite")
