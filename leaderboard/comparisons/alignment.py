"""Several comparisons on the scenarios that all of them have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cavbench.leaderboard.comparisons.comparison import Comparison
from cavbench.scenarios import Cell
from cavbench.statistics.estimates import Array


@dataclass(frozen=True, eq=False)
class Aligned:
    """The scores of several comparisons on the same scenarios.

    Args:
        scores: [R, C, E] each, of the metric.
        runs: training or patch seeds [R].
        cells: [C].
        seeds: scenario seeds [E].
    """

    scores: list[Array]
    runs: tuple[int, ...]
    cells: tuple[Cell, ...]
    seeds: tuple[int, ...]


def align(comparisons: Sequence[Comparison]) -> Aligned | None:
    """The scores on the runs, cells and scenario seeds that all comparisons have; None where there are none."""
    own = [one.own for one in comparisons]
    seeded = [one.own.runs for one in comparisons if not one.stands_for_all] or [own[0].runs]
    runs = sorted(set.intersection(*map(set, seeded)))
    cells = [cell for cell in own[0].cells if all(cell in one.cells for one in own)]
    seeds = sorted(set.intersection(*(set(one.seeds) for one in own)))
    if not (runs and cells and seeds):
        return None
    scores = [one.scores[one.own.places(runs, cells, seeds)] for one in comparisons]
    return Aligned(scores, tuple(runs), tuple(cells), tuple(seeds))
