"""The score of a defended victim where the strongest attack of each cell counts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.scenarios import Cell
from bench.statistics.episodes import unit_interval
from bench.statistics.estimates import Array, Interval, interval
from leaderboard.comparisons.alignment import Aligned, align
from leaderboard.comparisons.comparison import Comparison


@dataclass(frozen=True, eq=False)
class Worst:
    """The robust score of a defended victim.

    Args:
        scores: [R, C, E] of the metric, under the strongest attack of each cell.
        runs: training or patch seeds.
        cells: [C].
        attacks: the strongest attack of each cell.
        rival: [C, E] of the baseline that the victim is compared with, on the same scenarios; NaN where it was not driven.
    """

    scores: Array
    runs: tuple[int, ...]
    cells: tuple[Cell, ...]
    attacks: tuple[Comparison, ...]
    rival: Array

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
        for attack, cell in zip(self.attacks, self.cells, strict=True):
            control = attack.clean
            if control and cell in control.cells:
                # A control that stands for all runs is one run, whatever their seeds are.
                runs = control.runs if control.runs == attack.own.runs else (0,)
                parts.append((runs, control.column(attack.track.metric)[:, control.cells.index(cell)]))
        scores = _joined(parts)
        return None if scores is None else unit_interval(scores)

    @cached_property
    def lead(self) -> Interval | None:
        """Minus the baseline of the cell, paired scenario by scenario, in the cells where that was driven."""
        known = np.isfinite(self.rival).all(1)
        return interval((self.scores - self.rival)[:, known]) if known.any() else None


def worst(attacks: Sequence[Comparison]) -> Worst:
    """Of each cell the attack with the lowest score, on the runs that all attacks share.

    An attack that shares no run with those that were driven more is left out.
    """
    kept: list[Comparison] = []
    shared: set[int] = set()
    for attack in sorted(attacks, key=lambda one: (one.stands_for_all, -one.own.table.num_rows)):
        own = shared if kept and attack.stands_for_all else set(attack.own.runs)
        if not kept or shared & own:
            shared = shared & own if kept else own
            kept.append(attack)
    runs = tuple(sorted(shared))
    cells = sorted({cell for attack in kept for cell in attack.cells}, key=kept[0].axes.place)
    chosen = [_strongest(kept, cell, runs) for cell in cells]
    fewest = min(scores.shape[1] for _, scores, _ in chosen)
    return Worst(
        scores=np.stack([scores[:, :fewest] for _, scores, _ in chosen], 1),
        runs=runs,
        cells=tuple(cells),
        attacks=tuple(attack for attack, _, _ in chosen),
        rival=np.stack([rival[:fewest] for _, _, rival in chosen]),
    )


def _strongest(attacks: Iterable[Comparison], cell: Cell, runs: Sequence[int]) -> tuple[Comparison, Array, Array]:
    """The attack with the lowest score in a cell, its scores [R, E], and those of the victim's baseline there [E]."""
    found = []
    for attack in attacks:
        if cell in attack.cells:
            place = attack.cells.index(cell)
            rows = [0] * len(runs) if attack.stands_for_all else [attack.own.runs.index(run) for run in runs]
            found.append((attack, attack.scores[rows, place]))
    attack, scores = min(found, key=lambda pair: float(pair[1].mean()))
    contrast = attack.track.contrast
    rival = attack.baselines.get(attack.rival) if contrast and contrast.side == "victim" else None
    if rival is None or cell not in rival.cells or rival.seeds != attack.own.seeds:
        return attack, scores, np.full(scores.shape[1], np.nan)
    return attack, scores, rival.column(attack.track.metric)[0, rival.cells.index(cell)]


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
