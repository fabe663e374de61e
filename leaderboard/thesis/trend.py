"""Does a score rise or fall with a setting, over training seeds? Page's trend test."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cavbench.statistics.estimates import Array

LEVEL = 0.05


@dataclass(frozen=True)
class Trend:
    """How a score moves with an ordered setting.

    Args:
        direction: `rises` or `falls` at the 5 % level (one-sided), else `does not change detectably`.
        p: of the direction found, or of the likelier one.
        correlation: Spearman's, mean over training seeds, in [-1, 1].
    """

    direction: Literal["rises", "falls", "does not change detectably"]
    p: float
    correlation: float


def trend(scores: Array) -> Trend:
    """Page's L test (Page 1963): every training seed ranks the settings, the ranks are compared with the settings'
    order.

    Args:
        scores: [R, S], R training seeds x S settings in rising order.

    Raises:
        ValueError: with fewer than two seeds or three settings.
    """
    # Imported here: scipy.stats alone takes a second, and only this report asks for it.
    from scipy.stats import page_trend_test, spearmanr

    runs, settings = scores.shape
    if runs < 2 or settings < 3:
        raise ValueError(f"a trend needs two training seeds and three settings, got {runs} and {settings}")
    rises = float(page_trend_test(scores).pvalue)
    falls = float(page_trend_test(scores[:, ::-1]).pvalue)
    order = range(settings)
    correlations = [float(spearmanr(order, run).statistic) if len(set(run)) > 1 else 0.0 for run in scores]
    correlation = sum(correlations) / runs
    if rises < LEVEL:
        return Trend("rises", rises, correlation)
    if falls < LEVEL:
        return Trend("falls", falls, correlation)
    return Trend("does not change detectably", min(rises, falls), correlation)
