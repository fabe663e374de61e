"""A curve of the score over an attack's budget or effort, in the cells where it can tell something."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cavbench.leaderboard.comparisons.alignment import Aligned
from cavbench.leaderboard.comparisons.comparison import Comparison
from cavbench.scenarios import Cell
from cavbench.statistics.estimates import Array, Interval, interval, share_interval

FLOOR, CEILING = 0.05, 0.95
"""A cell tells nothing where even the first point leaves less than `FLOOR`, or even the last more than `CEILING` of the score
without an attack (of 1 where that was not driven)."""
ENOUGH_CELLS = 3
"""Cells below which a curve is no evidence about a grid of more."""


@dataclass(frozen=True, eq=False)
class Curve:
    """Attacks that differ in one thing, in rising order, on the same scenarios.

    Args:
        points: the attacks [P].
        values: [P, R, C, E] of the metric.
        cells: [C], without those at the floor and at the ceiling.
        left_out: number of those.
    """

    points: tuple[Comparison, ...]
    values: Array
    cells: tuple[Cell, ...]
    left_out: int

    @classmethod
    def of(cls, points: Sequence[Comparison], aligned: Aligned) -> Curve | None:
        """The curve in the cells that tell something; None where there are none."""
        values = np.stack(aligned.scores)
        by_cell = values.mean((1, 3))
        highest = CEILING * np.array([_clean(points, cell) for cell in aligned.cells])
        kept = np.flatnonzero((by_cell[0] >= FLOOR) & (by_cell[-1] <= highest))
        if not len(kept):
            return None
        cells = tuple(aligned.cells[place] for place in kept)
        return cls(tuple(points), values[:, :, kept], cells, len(aligned.cells) - len(kept))

    @cached_property
    def scores(self) -> list[Interval]:
        """Of each point."""
        return [share_interval(values) for values in self.values]

    def fall(self, first: int, second: int) -> Interval:
        """The score at one point minus that at another, paired."""
        return interval(self.values[first] - self.values[second])

    @property
    def tells(self) -> bool:
        """Whether it has enough cells: `ENOUGH_CELLS`, or all that were driven."""
        return len(self.cells) >= min(ENOUGH_CELLS, max(len(one.cells) for one in self.points))

    @property
    def where(self) -> str:
        """Its cells in words."""
        all_cells = max(len(one.cells) for one in self.points)
        said = f"{len(self.cells)} of {all_cells} cell{'s' * (all_cells != 1)}"
        return f"{said} ({self.left_out} at the floor or the ceiling)" if self.left_out else said


def _clean(points: Sequence[Comparison], cell: Cell) -> float:
    """The score without an attack in a cell; 1 where it was not driven."""
    for one in points:
        if one.clean and cell in one.clean.cells:
            return float(one.clean.only(cells=[cell]).column(one.track.metric).mean())
    return 1.0
