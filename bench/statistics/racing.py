"""Racing: all attacks of a suite drive a pilot, and the two strongest of it drive the rest (docs/statistics.md).

The rule: `KEPT` attacks go on, chosen by their means over all cells of the pilot. That has the first `PILOT_SCENARIOS` scenarios
of each cell and the first `PILOT_RUNS` trainings. A choice in each cell would be worse: it would rest on too few scenarios.
studies/racing.md has what it costs and how well it finds the score (`python -m studies.racing`).
"""

from __future__ import annotations

import numpy as np

from cavbench.statistics.estimates import Array, interval
from cavbench.statistics.strongest import FOLDS, TIE

KEPT, PILOT_RUNS, PILOT_SCENARIOS = 2, 5, 10


def kept(scores: Array) -> list[int]:
    """The attacks that go on: those with the lowest means, in the order of their means, and all that equal the last of them.

    Args:
        scores: [A, R, C, E] of A attacks in the pilot: R runs, C cells, E scenarios.
    """
    means = scores.mean((1, 2, 3)).round(9)
    order = np.argsort(means, kind="stable")
    return [int(place) for place in order if means[place] <= means[order[:KEPT][-1]] + TIE]


def by_the_rule(scores: Array, went_on: list[int]) -> bool:
    """Whether all attacks went on that a race keeps: no other one was as strong in the pilot as the strongest `KEPT` of these.

    Weaker ones may have gone on, too: they can only lower the score.

    Args:
        scores: [A, R, C, E] of all attacks in the pilot.
        went_on: places of those that have more than the pilot.
    """
    means = scores.mean((1, 2, 3))
    others = [place for place in range(len(scores)) if place not in went_on]
    if len(went_on) < KEPT:
        return False
    return not others or bool(np.sort(means[went_on])[KEPT - 1] < means[others].min() - TIE)


def hidden(scores: Array) -> float:
    """By how much the score may be too high because the others were dropped: a bound of 97.5 %, at least 0.

    The pilot is raced once more, on a part of itself. In each fold of its scenarios, two attacks are chosen on the others, and
    so is, in each cell, the strongest of these two and the strongest of all. What the race loses is the first minus the second,
    on the scenarios of the fold. That is too little: one of many is chosen less well than one of two. On the scenarios it was
    chosen on, the difference is too large, by luck. The middle of both counts, or 0 if that is less, and the upper margin of the
    interval of the first.

    Args:
        scores: [A, R, C, E] of all attacks in the pilot.
    """
    fold = np.arange(scores.shape[-1]) % min(FOLDS, scores.shape[-1])
    cells = np.arange(scores.shape[2])
    lost, lucky = np.zeros(scores.shape[1:]), []
    for place in np.unique(fold):
        same = fold == place
        means = scores[..., ~same].mean((1, 3))
        chosen = kept(scores[..., ~same])
        two, every = np.asarray(chosen)[means[chosen].argmin(0)], means.argmin(0)
        lost[..., same] = np.moveaxis(scores[two, :, cells] - scores[every, :, cells], 0, 1)[..., same]
        lucky.append((means[two, cells] - means[every, cells]).mean())
    found = interval(lost)
    middle = found.estimate + max(float(np.mean(lucky)) - found.estimate, 0.0) / 2
    return max(middle, 0.0) + found.high - found.estimate
