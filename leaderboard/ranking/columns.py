"""The columns of a leaderboard: one list, of which the terminal, CSV, JSON, LaTeX, the page and the documentation are made.

A new column is one entry here. How a number looks (a percentage, a mark, a link) is up to each writer, by the column's `kind`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

from cavbench.core.track import Measure, Track
from cavbench.leaderboard.comparisons.comparison import Comparison, parameters
from cavbench.leaderboard.ranking.boards import Board, Row
from cavbench.leaderboard.ranking.worst import Worst
from cavbench.scenarios.axes import written
from cavbench.statistics.estimates import Array, Interval

Value = str | float | Interval | None
"""What a row has in a column. An interval without bounds (NaN) is one where they cannot be known."""
Kind = Literal["text", "count", "number", "share", "difference"]
"""Texts; whole numbers; numbers; shares of episodes, 0 to 1; differences of scores."""
Called = Callable[[Comparison, str], str]
"""What a table calls the `attack`, `defense` or `victim` of a comparison."""


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of a leaderboard.

    Args:
        name: in JSON and CSV.
        title: on the page and in LaTeX, in one line.
        meaning: one line for readers.
        value: what a row has in it.
        kind: of the value.
        short: heading on the terminal, of at most two lines; empty where the terminal does not show it.
        by_cell: [C'] the estimate in each cell of a row, NaN where it is not known; None where it is about all cells together.
        digits: behind the point.
        interval: whether values are intervals, which take three columns in CSV.
        shown: whether tables for readers have it; otherwise files only.
        optional: whether a leaderboard leaves it out where no row has a number in it.
        spare: a narrow terminal leaves out the columns with the highest number first.
    """

    name: str
    title: str
    meaning: str
    value: Callable[[Row, Called], Value]
    kind: Kind = "number"
    short: str = ""
    by_cell: Callable[[Worst], Array] | None = None
    digits: int = 2
    interval: bool = False
    shown: bool = True
    optional: bool = False
    spare: int = 0


def columns(board: Board) -> list[Column]:
    """The columns of a leaderboard, from left to right, without optional ones that say nothing of any row."""
    return [one for one in all_columns(board.track) if not one.optional or any(_says(one, row) for row in board.rows)]


def all_columns(track: Track) -> list[Column]:
    """Every column that a leaderboard of a track can have, from left to right."""
    return [*_names(), *_scores(track), *_faults(), *_rest(track)]


def _says(column: Column, row: Row) -> bool:
    """Whether a row has a number in a column."""
    found = column.value(row, lambda one, kind: "")
    number = found.estimate if isinstance(found, Interval) else found
    return number is not None and not (isinstance(number, float) and math.isnan(number))


def _names() -> Iterator[Column]:
    yield Column(
        name="rank",
        title="Rank",
        short="\nrank",
        meaning="rank group, from 1; flagged rows rank below all others; empty for a victim that sees nothing without an attack, "
        "and for a row with one patch",
        value=lambda row, called: row.group or None,
        kind="count",
        digits=0,
    )
    for kind, title in (("defense", "Defence"), ("victim", "Victim")):
        yield Column(
            name=kind,
            title=title,
            short=title.lower(),
            meaning=f"the {title.lower()}, with the parameters that tell it from others of its name",
            value=lambda row, called, kind=kind: called(row.attacks[0], kind),  # type: ignore[misc]
            kind="text",
        )
        yield Column(
            name=f"{kind}_params",
            title=f"{title}'s parameters",
            meaning=f"all parameters of the {title.lower()}, as JSON",
            value=lambda row, called, kind=kind: _params(row.attacks[0], kind),  # type: ignore[misc]
            kind="text",
            shown=False,
        )


def _scores(track: Track) -> Iterator[Column]:
    contrast = track.contrast
    yield Column(
        name="score",
        title="Worst case",
        short=f"{track.metric_title}\nworst [95 %]",
        meaning="score under the strongest attack of each cell, 0 to 1; more is better for the victim",
        value=lambda row, called: row.worst.score,
        by_cell=lambda worst: worst.scores.mean((0, 2)),
        interval=True,
    )
    if failure := next((one for one in track.measures if one.column == track.failure), None):
        title = " ".join(failure.heading.split())
        yield Column(
            name="failed",
            title=title[:1].upper() + title[1:],
            short=failure.heading,
            meaning="share of episodes that fail (a crash, or running the sign) under the same attacks",
            value=lambda row, called: row.worst.failure,
            kind="share",
            by_cell=lambda worst: worst.failed.mean((0, 2)),
            interval=True,
        )
    yield from (_measure(one) for one in track.measures if one.ranked)
    yield Column(
        name="worst_cell_score",
        title="Worst cell",
        short="worst\ncell",
        meaning="the lowest score of a cell",
        value=lambda row, called: row.worst.worst_cell[1],
        interval=True,
        spare=3,
    )
    yield Column(
        name="worst_cell",
        title="In",
        short="\n ",
        meaning="the cell with the lowest score",
        value=lambda row, called: " × ".join(map(written, row.worst.worst_cell[0].values())),
        kind="text",
        spare=5,
    )
    yield Column(
        name="clean",
        title="Clean",
        short="\nclean",
        meaning="score without an attack",
        value=lambda row, called: row.worst.clean,
        by_cell=lambda worst: worst.clean_by_cell,
        interval=True,
        spare=4,
    )
    yield Column(
        name="site_score",
        title="Knows the site",
        short="knows\nsite",
        meaning="score under the strongest attacker who prepares on the approaches that are scored, with the same budget",
        value=lambda row, called: row.site.score if row.site else None,
        interval=True,
        optional=True,
        spare=2,
    )
    yield Column(
        name="certified",
        title="Certified",
        short="certi-\nfied",
        meaning="lower bound of the score under every attack of the threat model",
        value=lambda row, called: row.worst.certified,
        optional=True,
        spare=3,
    )
    if contrast and contrast.side == "victim":
        yield Column(
            name="lead",
            title=f"Against {contrast.title.removeprefix('the ')}",
            short=contrast.short,
            meaning=f"score minus that of {contrast.title}, paired scenario by scenario",
            value=lambda row, called: row.worst.lead,
            kind="difference",
            by_cell=lambda worst: (worst.scores - worst.rival).mean((0, 2)),
            interval=True,
            spare=2,
        )


def _faults() -> Iterator[Column]:
    """What faults without an adversary do to a row; empty where they were not driven."""
    yield Column(
        name="faults_suite",
        title="Suite of faults",
        meaning="the version of the suite of faults that was driven; empty: none of them wholly",
        value=lambda row, called: (row.faults.suite or None) if row.faults else None,
        kind="text",
        shown=False,
        optional=True,
    )
    for name, title, short, meaning, kind, digits, spare, value in (
        ("mean", "Faults", "faults\nmean", "mean score under faults without an adversary", "number", 2, 2, "mean"),
        ("worst", "Worst fault", "faults\nworst", "score under the worst of these faults", "number", 2, 4, "worst"),
        (
            *("failed", "Crashed, faults", "faults\ncrashed", "share of episodes that crash, over all faults"),
            *("share", 0, 3, "crashed"),
        ),
        ("of_idm", "Faults, of IDM", "of\nIDM", "that mean as a share of IDM's score there", "share", 0, 5, "of_idm"),
    ):
        yield Column(
            name=f"faults_{name}",
            title=title,
            short=short,
            meaning=f"{meaning}; empty: not measured",
            value=lambda row, called, value=value: getattr(row.faults, value) if row.faults else None,  # type: ignore[misc]
            kind=kind,  # type: ignore[arg-type]
            digits=digits,
            optional=True,
            shown=name != "of_idm",
            spare=spare,
        )


def _rest(track: Track) -> Iterator[Column]:
    yield Column(
        name="strongest_attack",
        title="Strongest attack",
        short="strongest\nattack",
        meaning="the single attack that is the strongest in most cells",
        value=lambda row, called: called(row.attacks[0], "attack"),
        kind="text",
        spare=1,
    )
    yield Column(
        name="attacks",
        title="Attacks",
        short="\nattacks",
        meaning="number of attacks that count: a score is only as good as these",
        value=lambda row, called: len(row.attacks),
        kind="count",
        digits=0,
        spare=6,
    )
    yield Column(
        name="strongest_attack_params",
        title="Its parameters",
        meaning="all parameters of that attack, as JSON",
        value=lambda row, called: _params(row.attacks[0], "attack"),
        kind="text",
        shown=False,
    )
    yield Column(
        name="flags",
        title="Flags",
        short="\n⚑",
        meaning="the flags that have fired, which cast doubt on the score",
        value=lambda row, called: " ".join(flag.name for flag in row.flags if flag.fired),
        kind="text",
    )
    for name, title, meaning, value in (
        ("remarks", "Remarks", "what else a reader must know", lambda row: " ".join(one.name for one in row.remarks)),
        (
            "training_seeds",
            f"{track.run}s",
            f"the {track.run}s",
            lambda row: " ".join(map(str, row.worst.runs)),
        ),
        ("cells", "Cells", "number of cells", lambda row: row.worst.shape[0]),
        (
            "scenarios",
            "Scenarios",
            f"{track.episode[1]} of a cell and {track.run}",
            lambda row: row.worst.shape[1],
        ),
    ):
        yield Column(
            name=name,
            title=title[:1].upper() + title[1:],
            meaning=meaning,
            value=lambda row, called, value=value: value(row),  # type: ignore[misc]
            kind="count" if name in ("cells", "scenarios") else "text",
            digits=0,
            shown=False,
        )


def _measure(measure: Measure) -> Column:
    """A ranked measure of the track, under the attack that is the strongest in most cells."""
    title = " ".join(measure.heading.split())
    return Column(
        name=measure.column,
        title=title[:1].upper() + title[1:],
        short=measure.heading,
        meaning=f"{title}, under the attack that is the strongest in most cells",
        value=lambda row, called: row.attacks[0].measured(measure),
        kind="share" if measure.unit == "share" else "number",
        digits=measure.digits,
        interval=True,
        optional=True,
        spare=measure.spare,
    )


def _params(one: Comparison, kind: str) -> str:
    return json.dumps(parameters(one.identity[f"{kind}_params"]), sort_keys=True)
