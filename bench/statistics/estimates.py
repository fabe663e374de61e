"""Estimates with intervals: interquartile mean and stratified bootstrap, Wilson rates, paired differences.

Pure functions on arrays; `bench.statistics.episodes` says what the arrays mean. Interquartile mean and resampling are those of
rliable and its `StratifiedBootstrap` (Agarwal et al. 2021, "Deep RL at the edge of the statistical precipice"). The resampling is
one vectorised pass with its own generator, because rliable 1.2 ignores its seed and uses numpy's global generator. `iqm` and
`wilson` equal scipy's `trim_mean` and `binomtest(...).proportion_ci` to the last digit of a table (a test compares them), but
are 6 and 100 times faster and need no `scipy.stats`, which takes 0.8 s to import.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

REPLICATES = 2000
"""Bootstrap draws. With 2000, another generator seed moves the bounds of an interval by about 2 % of its width."""
CONFIDENCE = 0.95
_TAILS = ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % confidence interval, in the unit of the measurement; the bounds are NaN if there is none."""

    estimate: float
    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high


def iqm(scores: Array, axis: int | None = None) -> Array:
    """Interquartile mean along `axis` (default: all): the mean without the lowest and the highest quarter.

    Defined as `rliable.metrics.aggregate_iqm`; of fewer than four values it is the mean.
    """
    count = scores.size if axis is None else scores.shape[axis]
    if count < 4:
        return np.asarray(scores.mean(axis))
    ordered = np.sort(scores, axis=axis)
    last = 0 if axis is None else axis
    return np.asarray(np.take(ordered, range(count // 4, count - count // 4), axis=last).mean(last))


def interval(scores: Array, *, seed: int = 0, replicates: int = REPLICATES) -> Interval:
    """Interquartile mean over runs and tasks, with a 95 % percentile interval from a stratified bootstrap.

    With two or more runs, runs are drawn with replacement within each task. With one run, episodes are drawn with replacement
    within each task; the interval then does not include the variation between training seeds.

    Args:
        scores: [R, C, E], R runs (training seeds) x C tasks (cells) x E episodes (scenario seeds), finite.
        seed: seed of the bootstrap's generator.
        replicates: number of bootstrap draws.

    Raises:
        ValueError: if `scores` is not three-dimensional, is empty, or holds a value that is not finite.
    """
    _check(scores)
    runs, tasks, episodes = scores.shape
    estimate = float(iqm(scores.mean(2)))
    if runs == 1 and episodes == 1:
        return Interval(estimate, np.nan, np.nan)
    generator = np.random.default_rng(seed)
    if runs > 1:
        drawn = _drawn(runs, tasks, seed, replicates)
        draws = scores.mean(2).ravel()[drawn].reshape(replicates, -1)
    else:
        draws = np.stack([_episode_means(task, generator, replicates) for task in scores[0]], 1)
    return _percentiles(estimate, iqm(draws, axis=1))


def task_intervals(scores: Array, *, seed: int = 0, replicates: int = REPLICATES) -> list[Interval]:
    """`interval` for each task separately, in one pass.

    Args:
        scores: [R, C, E], as in `interval`.
        seed: seed of the bootstrap's generator.
        replicates: number of bootstrap draws.
    """
    _check(scores)
    runs, tasks, _ = scores.shape
    if runs == 1:
        return [interval(scores[:, [task]], seed=seed, replicates=replicates) for task in range(tasks)]
    drawn = _drawn(runs, 1, seed, replicates)[..., 0]
    means = scores.mean(2)
    estimates, (low, high) = iqm(means, 0), np.quantile(iqm(means[drawn], 1), _TAILS, axis=0)
    bounds = np.minimum(low, estimates), np.maximum(high, estimates)
    return [Interval(*map(float, values)) for values in zip(estimates, *bounds, strict=True)]


@cache
def _drawn(runs: int, tasks: int, seed: int, replicates: int) -> NDArray[np.int64]:
    """[replicates, R, C] flat indices into [R, C] of the runs drawn for each task."""
    drawn = np.random.default_rng(seed).integers(runs, size=(replicates, runs, tasks))
    return drawn * tasks + np.arange(tasks)


def _episode_means(values: Array, generator: np.random.Generator, replicates: int) -> Array:
    """[replicates] means of samples of `values` [E], drawn with replacement."""
    drawn = generator.integers(len(values), size=(replicates, len(values)))
    return np.asarray(values[drawn].mean(1))


def _percentiles(estimate: float, draws: Array) -> Interval:
    """The percentile interval, widened to include the estimate, which the bootstrap of a trimmed mean can just miss."""
    low, high = np.quantile(draws, _TAILS)
    return Interval(estimate, min(float(low), estimate), max(float(high), estimate))


def _check(scores: Array) -> None:
    if scores.ndim != 3 or not scores.size:
        raise ValueError(f"scores must be runs x tasks x episodes and not empty, got shape {scores.shape}")
    if not np.isfinite(scores).all():
        raise ValueError("scores must be finite")


def wilson(successes: float, trials: int) -> Interval:
    """A rate in [0, 1] with its 95 % Wilson score interval (Wilson 1927), which does not collapse at 0 or 1.

    Raises:
        ValueError: unless 0 <= successes <= trials.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"successes must be between 0 and the {trials} trials, got {successes}")
    if trials == 0:
        return Interval(np.nan, 0.0, 1.0)
    z2 = NormalDist().inv_cdf((1 + CONFIDENCE) / 2) ** 2
    rate = successes / trials
    centre = (rate + z2 / (2 * trials)) / (1 + z2 / trials)
    half = math.sqrt(z2 * (rate * (1 - rate) / trials + z2 / (4 * trials**2))) / (1 + z2 / trials)
    return Interval(rate, min(max(centre - half, 0.0), rate), max(min(centre + half, 1.0), rate))
