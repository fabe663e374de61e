"""What the strongest attack of each cell leaves of a defended victim."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.scenarios import Cell
from bench.statistics.episodes import unit_interval
from bench.statistics.estimates import Array, Interval, interval
from envs.weather import WEATHERS
from leaderboard.entries import Aligned, Entry, align


@dataclass(frozen=True, eq=False)
class Worst:
    """What is left of a defended victim where in every cell the strongest attack counts.

    Args:
        scores: [R, C, E] of the ranking metric.
        runs: training or patch seeds.
        cells: [C].
        attacks: the strongest attack of each cell.
        blind: [C, E] of the best blind policy on the same scenarios; NaN where it was not driven.
    """

    scores: Array
    runs: tuple[int, ...]
    cells: tuple[Cell, ...]
    attacks: tuple[Entry, ...]
    blind: Array

    @cached_property
    def score(self) -> Interval:
        """Over all runs and cells."""
        return unit_interval(self.scores)

    @cached_property
    def name(self) -> str:
        """The attack that is the strongest in most cells."""
        return str(max(self.attacks, key=self.attacks.count).identity["attack"])

    @cached_property
    def clean(self) -> Interval | None:
        """The same cells without an attack, as far as they were driven."""
        parts = []
        for entry, cell in zip(self.attacks, self.cells, strict=True):
            control = entry.control
            if control and cell in control.cells:
                # The sign without a patch is one run, whatever the patches' seeds are.
                runs = control.runs if entry.track == "driving" else (0,)
                parts.append((runs, control.column(entry.metric)[:, control.cells.index(cell)]))
        scores = _joined(parts)
        return None if scores is None else unit_interval(scores)

    @cached_property
    def lead(self) -> Interval | None:
        """Minus the best blind policy of the cell, paired scenario by scenario, in the cells where that was driven."""
        known = np.isfinite(self.blind).all(1)
        return interval((self.scores - self.blind)[:, known]) if known.any() else None


def worst(entries: Sequence[Entry]) -> Worst:
    """Of each cell the attack that leaves least, on the runs that all attacks share.

    An attack that shares no run with those that were driven more is left out.
    """
    kept: list[Entry] = []
    shared: set[int] = set()
    for entry in sorted(entries, key=lambda entry: (entry.stands_for_all, -entry.own.table.num_rows)):
        own = shared if kept and entry.stands_for_all else set(entry.own.runs)
        if not kept or shared & own:
            shared = shared & own if kept else own
            kept.append(entry)
    runs = tuple(sorted(shared))
    order = list(WEATHERS)
    cells = sorted(
        {cell for entry in kept for cell in entry.own.cells},
        key=lambda cell: (order.index(cell.weather), cell.lanes, cell.density),
    )
    chosen = [_strongest(kept, cell, runs) for cell in cells]
    fewest = min(scores.shape[1] for _, scores, _ in chosen)
    return Worst(
        scores=np.stack([scores[:, :fewest] for _, scores, _ in chosen], 1),
        runs=runs,
        cells=tuple(cells),
        attacks=tuple(entry for entry, _, _ in chosen),
        blind=np.stack([blind[:fewest] for _, _, blind in chosen]),
    )


def _strongest(entries: Iterable[Entry], cell: Cell, runs: Sequence[int]) -> tuple[Entry, Array, Array]:
    """The attack that leaves least in a cell, what it leaves [R, E], and what the best blind policy gets there [E]."""
    found = []
    for entry in entries:
        if cell in entry.own.cells:
            place = entry.own.cells.index(cell)
            rows = [0] * len(runs) if entry.stands_for_all else [entry.own.runs.index(run) for run in runs]
            found.append((entry, entry.scores[rows, place]))
    entry, scores = min(found, key=lambda pair: float(pair[1].mean()))
    blind = entry.blind
    if blind is None or cell not in blind.cells or blind.seeds != entry.own.seeds:
        return entry, scores, np.full(scores.shape[1], np.nan)
    return entry, scores, blind.column(entry.metric)[0, blind.cells.index(cell)]


def margin(first: Worst, second: Worst) -> Interval | None:
    """`first` minus `second`, paired, in the cells, runs and scenarios that both have; None where they have none."""
    parts, known = [], dict[tuple[int, int], Aligned | None]()
    for cell in first.cells:
        if cell in second.cells:
            one, other = (worst.attacks[worst.cells.index(cell)] for worst in (first, second))
            key = id(one), id(other)
            if key not in known:
                known[key] = align([one, other])
            if aligned := known[key]:
                place = aligned.cells.index(cell)
                parts.append((aligned.runs, (aligned.scores[0] - aligned.scores[1])[:, place]))
    differences = _joined(parts)
    return None if differences is None else interval(differences)


def _joined(parts: Sequence[tuple[tuple[int, ...], Array]]) -> Array | None:
    """[R, C, E] of what single cells have, each as its runs and [R, E]: the runs that all have; None where there are none."""
    runs = sorted(set.intersection(*(set(own) for own, _ in parts))) if parts else []
    if not runs:
        return None
    fewest = min(values.shape[1] for _, values in parts)
    return np.stack([values[[own.index(run) for run in runs], :fewest] for own, values in parts], 1)
