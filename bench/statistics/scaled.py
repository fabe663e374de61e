"""Scores on the scale between two references: 0 is a policy that ignores its input, 1 is one that knows all.

Pure functions on arrays; docs/leaderboard_worlds.md says why worlds are compared on this scale.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cavbench.statistics.estimates import Array, Interval, components, interval


def has_scale(low: Array, high: Array) -> bool:
    """Whether the upper reference is above the lower one: the 95 % interval of the paired difference must exclude 0.

    Args:
        low, high: [C, E] scores of the references in C cells and E scenarios.
    """
    return bool(interval((high - low)[None]).low > 0)


def scaled(scores: Array, low: Array, high: Array) -> Array:
    """A score as a share of the way from `low` to `high`, in parts whose mean it is: cut to [0, 1].

    The share is a ratio of two means. Its parts are those of its linearisation (the delta method), so that their variance
    between runs and between scenarios is that of the ratio, with what both references vary. The cut moves all parts alike.

    Args:
        scores: [R, C, E] of runs, cells and scenarios.
        low, high: [C, E] scores of the references on the same scenarios.

    Returns:
        [R, E].
    """
    span = high - low
    share = float((scores - low).mean() / span.mean())
    parts = (scores - low - share * span).mean(1) / span.mean()
    return np.asarray(parts + min(max(share, 0.0), 1.0))


def over_worlds(parts: Sequence[Array]) -> Array:
    """[R, W, E] the parts of W worlds side by side: runs and scenarios in their order, as many as every world has.

    Scenarios of two worlds have nothing in common, and the runs are the same trainings or others of their kind. The mean over
    worlds of each run and scenario is a draw in either case, so the worlds are to an interval what cells are.

    Args:
        parts: of each world [R_w, E_w].
    """
    runs, scenarios = (min(one.shape[axis] for one in parts) for axis in (0, 1))
    return np.stack([one[:runs, :scenarios] for one in parts], axis=1)


def mean_of(parts: Array) -> Interval:
    """The mean of parts [R, W, E] with its 95 % interval for other runs and scenarios in the same worlds, within [0, 1]."""
    means = parts.mean(1)
    estimate, margin = float(np.clip(means.mean(), 0.0, 1.0)), float(components(means).margin())
    # Without an interval the bounds are NaN, which `clip` keeps.
    low, high = np.clip([estimate - margin, estimate + margin], 0.0, 1.0).tolist()
    return Interval(estimate, low, high)
