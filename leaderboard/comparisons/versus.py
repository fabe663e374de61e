"""Two sets of results side by side: paired differences of what both have driven, and what became better or worse.

A row is a defended victim under one attack. Scores are paired by training seed, cell and scenario.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from cavbench.core.track import track
from cavbench.errors import UserError
from cavbench.leaderboard.comparisons.comparison import ENOUGH_SEEDS, Comparison
from cavbench.leaderboard.comparisons.matching import Match, Matching, Names, by, rows_of
from cavbench.leaderboard.comparisons.sources import Records, Source, source
from cavbench.scenarios import Cell
from cavbench.statistics.estimates import Array, Interval, interval, share_interval
from cavbench.statistics.paired import LEVEL, holm, p_values
from cavbench.statistics.strongest import strongest_of, under

Verdict = Literal["better", "worse", "same"]


@dataclass(frozen=True)
class Line:
    """A row, or one of its cells, on both sides.

    Args:
        track: name of the track.
        defended: the defended victim; "FIRST → SECOND" where the sides differ.
        attack: likewise.
        cell: the cell; None for all.
        first, second: the scores.
        difference: second - first, with its own 95 % interval.
        p: adjusted for the number of rows, or of cells (`cavbench.statistics.paired.holm`).
        shape: training seeds, cells and scenarios that both sides have.
    """

    track: str
    defended: str
    attack: str
    cell: Cell | None
    first: Interval
    second: Interval
    difference: Interval
    p: float
    shape: tuple[int, int, int]

    @property
    def verdict(self) -> Verdict:
        """Whether the second side's victim scores significantly higher or lower, with all lines of its kind in mind."""
        if not self.p < LEVEL:
            return "same"
        return "better" if self.difference.estimate > 0 else "worse"


@dataclass(frozen=True)
class Versus:
    """A comparison of two sources.

    Args:
        names: what was compared.
        rows: over all cells, the strongest attack last.
        cells: the same cell by cell.
        left_out: what only one side has, or cannot be compared, one line each.
        remarks: what a reader must know, one line each.
    """

    names: tuple[str, str]
    rows: tuple[Line, ...]
    cells: tuple[Line, ...]
    left_out: tuple[str, ...]
    remarks: tuple[str, ...]

    @property
    def worse(self) -> list[Line]:
        """The rows in which the second side is significantly worse."""
        return [line for line in self.rows if line.verdict == "worse"]

    def content(self) -> dict[str, Any]:
        """The content of the document `compare` (`cavbench.documents`)."""
        return {
            "first": self.names[0],
            "second": self.names[1],
            "level": LEVEL,
            "rows": [_written(line) for line in self.rows],
            "cells": [_written(line) for line in self.cells],
            "left_out": list(self.left_out),
            "remarks": list(self.remarks),
        }


def compare(
    first: str | Mapping[str, pa.Table], second: str | Mapping[str, pa.Table], names: Sequence[str] = ()
) -> Versus:
    """Compare two sources, or records that were read already.

    Args:
        first: a source (`cavbench.leaderboard.comparisons.sources`), or records by track.
        second: what may be better or worse than the first.
        names: what the two are called; by default as they were typed.

    Raises:
        UserError: if a source cannot be read, or nothing in the two can be compared; it says why.
    """
    sides = [source(one) if isinstance(one, str) else Source("", partial(_given, dict(one))) for one in (first, second)]
    called = (names[0], names[1]) if names else (sides[0].name, sides[1].name)
    same = frozenset(name for name, digest in sides[0].digests.items() if sides[1].digests.get(name) == digest)
    left = [f"{len(same)} row{'s have' if len(same) > 1 else ' has'} the same records on both sides"] if same else []
    read = [side.records(same) for side in sides]
    if same and not all(read):
        for name, side, other in zip(called, sides, sides[::-1], strict=True):
            left += [f"only {name} has the row {row}" for row in side.digests if row not in other.digests]
        return Versus(called, (), (), tuple(left), ())
    shared = [name for name in read[0] if name in read[1]]
    if not shared:
        tracks = [" and ".join(one) or "none" for one in read]
        raise UserError(f"nothing can be compared: {called[0]} is of the track {tracks[0]}, {called[1]} of {tracks[1]}")
    matches, why = [], []
    for name in shared:
        found = Matching(called, *(rows_of(one[name], track(name)) for one in read))
        matches += found.matches
        left += found.left
        why += found.why
    if not matches:
        raise UserError(f"nothing can be compared: {'; '.join([*why, *left][:4])}")
    rows, cells = _lines(matches)
    return Versus(called, rows, cells, (*why, *left), tuple(_remarks(matches)))


def _given(records: Records, _: frozenset[str]) -> Records:
    """Records that were read already."""
    return records


def _lines(matches: Sequence[Match]) -> tuple[tuple[Line, ...], tuple[Line, ...]]:
    """The lines of all rows and of all cells, with p-values adjusted for the number of either."""
    called = Names([one for match in matches for one in (match.first, match.second)])
    rows: list[tuple[Line, Array]] = []
    cells: list[tuple[Line, Array]] = []
    for together in by(matches, lambda one: (one.first.track.name, one.first.defended)).values():
        sides = [(_arrow(called.attack, match), match, *match.scores()) for match in together]
        if strongest := _strongest(together):
            sides.append(strongest)
        for attack, match, first, second in sides:
            about = (match.first.track.name, _arrow(called.defended, match), attack)
            rows.append(_line(about, None, first, second))
            each = zip(match.cells, np.moveaxis(first, 1, 0), np.moveaxis(second, 1, 0), strict=True)
            cells += [_line(about, cell, one[:, None], other[:, None]) for cell, one, other in each]
    return _adjusted(rows), _adjusted(cells)


def _line(about: tuple[str, str, str], cell: Cell | None, first: Array, second: Array) -> tuple[Line, Array]:
    scores = share_interval(first), share_interval(second)
    line = Line(*about, cell, *scores, interval(second - first), 1.0, first.shape)
    return line, (second - first).mean(1)


def _adjusted(lines: Sequence[tuple[Line, Array]]) -> tuple[Line, ...]:
    p = holm(np.array([float(p_values(differences)) for _, differences in lines]))
    return tuple(replace(line, p=float(own)) for (line, _), own in zip(lines, p, strict=True))


def _strongest(together: Sequence[Match]) -> tuple[str, Match, Array, Array] | None:
    """The strongest attack of each cell on either side, among those that both have; None with fewer than two."""
    attacks = [match for match in together if match.first.is_attacked]
    if len(attacks) < 2:
        return None
    runs, cells, seeds = attacks[0].runs, attacks[0].cells, attacks[0].seeds
    for one in attacks[1:]:
        runs = tuple(run for run in runs if run in one.runs)
        cells = tuple(cell for cell in cells if cell in one.cells)
        seeds = tuple(seed for seed in seeds if seed in one.seeds)
    if not (runs and cells and seeds):
        return None
    match = replace(attacks[0], runs=runs, cells=cells, seeds=seeds)
    sides = zip(*(replace(match, first=one.first, second=one.second).scores() for one in attacks), strict=True)
    scores = [under(strongest_of(np.stack(side)), np.stack(side)) for side in sides]
    return f"strongest of {len(attacks)}", match, scores[0], scores[1]


def _arrow(called: Callable[[Comparison], str], match: Match) -> str:
    """What something is called on both sides."""
    one, other = called(match.first), called(match.second)
    return one if one == other else f"{one} → {other}"


def _remarks(matches: Sequence[Match]) -> Iterator[str]:
    """What the numbers do not say."""
    few = [
        match
        for match in matches
        if len(match.runs) < ENOUGH_SEEDS and match.first.trained and not _same_weights(match)
    ]
    if few:
        track = few[0].first.track
        fewest = min(len(match.runs) for match in few)
        about = f"{fewest} {track.run}{'' if fewest == 1 else 's'}"
        yield f"{about}: these differences say little, or nothing, about other trainings of the same methods"
    dropped = sum(match.first.own.table.num_rows + match.second.own.table.num_rows for match in matches)
    kept = 2 * sum(len(match.runs) * len(match.cells) * len(match.seeds) for match in matches)
    if kept < dropped:
        yield f"{dropped - kept} of {dropped} episodes are left out: the other side has not driven the same scenario"


def _same_weights(match: Match) -> bool:
    sets = [set(one.own.table["weights_sha256"].unique().to_pylist()) for one in (match.first, match.second)]
    return sets[0] == sets[1]


def _written(line: Line) -> dict[str, Any]:
    def bounds(found: Interval) -> dict[str, float | None]:
        values = {"estimate": found.estimate, "low": found.low, "high": found.high}
        return {name: None if np.isnan(value) else float(value) for name, value in values.items()}

    runs, cells, scenarios = line.shape
    return {
        "track": line.track,
        "defended": line.defended,
        "attack": line.attack,
        "cell": None if line.cell is None else dict(line.cell),
        "first": bounds(line.first),
        "second": bounds(line.second),
        "difference": bounds(line.difference),
        "p": line.p,
        "verdict": line.verdict,
        "runs": runs,
        "cells": cells,
        "scenarios": scenarios,
    }
