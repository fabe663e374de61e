"""The ranking of every threat model on the terminal, with the flags that have fired."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import pyarrow as pa
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from cavbench.core.track import Track
from cavbench.leaderboard.comparisons.naming import Varying, component, varying
from cavbench.leaderboard.published import every_track
from cavbench.leaderboard.ranking.boards import Board, Row, read_boards
from cavbench.leaderboard.ranking.flags import FLAGS
from cavbench.leaderboard.terminal.columns import written
from cavbench.leaderboard.terminal.layout import STRIP, Column, Section, axis, cell_name, fitted
from cavbench.leaderboard.terminal.text import (
    ATTACKED,
    BASELINE,
    CLEAN,
    estimate,
    number,
    of_frames,
    share,
    signed,
    strip,
    verdict,
)
from cavbench.statistics.estimates import share_interval

ADDED = 0.01
"""What an attack must add to be named."""


def leaderboard_report(records: Mapping[str, pa.Table], console: Console) -> None:
    """Print the ranking of every threat model, with the flags that have fired.

    Args:
        records: by track (`cavbench.records.schema`); where there are none, the published records count.
        console: where to print.
    """
    print_boards(read_boards(records or every_track())[0], console)


def print_boards(boards: Sequence[Board], console: Console) -> None:
    """Print the leaderboard of each threat model."""
    for board in boards:
        norm, budget, access, queries, frames = board.threat
        allowed = f"{board.grid}, {norm} {budget:g}, access {access}, {queries} queries{of_frames(frames)}"
        title = Text.assemble((board.track.name, "bold"), f" in {board.world[0]}, {allowed}")
        console.print(Padding(title, (1, 1)))
        console.print(Padding(fitted(_columns(board), _sections(board), console), (0, 1)))
        flagged = BELOW if any(row.flagged for row in board.rows) else ""
        console.print(Padding(Text(flagged + SHARED, style="dim"), (0, 1)))
        for name, drive in board.baselines.items():
            score = estimate(share_interval(drive.column(board.track.metric)), style=BASELINE)
            console.print(Padding(Text.assemble(f"{name}: ", score), (0, 3)))
        for row in board.rows:
            if len(row.attacks) > 1:
                console.print(
                    Padding(Text.assemble(("added ", "dim"), f"{_name(row, board)}: ", (_added(row), "dim")), (0, 1))
                )
            if row.flagged:
                titles = "; ".join(FLAGS[flag.name][0] for flag in row.flags if flag.fired)
                said = Text.assemble(("flagged ", "yellow"), f"{_name(row, board)}: ", (titles, "dim"))
                console.print(Padding(said, (0, 1)))
        for line in _notes(board):
            console.print(Padding(line, (0, 1)))
    console.print()


FLAGGED = "⚑"
BELOW = f"{FLAGGED} flagged: ranks below all rows without a flag, whatever its score; why is said below. "
SHARED = "Rows of one rank are not told apart from its first."
"""What stands under a ranking, so that its order is understood."""


def _sections(board: Board) -> list[Section[Row]]:
    """The rows without a flag, then the others."""
    parts = ([row for row in board.rows if row.flagged is flagged] for flagged in (False, True))
    return [Section(part) for part in parts if part]


def _notes(board: Board) -> Iterator[Text]:
    """What a reader must know of the scores besides the flags; of several rows in one line."""
    about: dict[str, list[str]] = {}
    for row in board.rows:
        for remark in row.remarks:
            about.setdefault(remark.text, []).append(_name(row, board))
    for text, names in about.items():
        yield Text.assemble(("note ", "yellow"), f"{'; '.join(names)}: ", (text, "dim"))


def _name(row: Row, board: Board) -> str:
    shown = _shown(board)
    return " ".join(component(row.attacks[0], kind, shown[kind]) for kind in ("defense", "victim"))


def _added(row: Row) -> str:
    """By how much each attack lowers the score further than all the others do, the most first."""
    shown = varying(row.attacks, "attack")
    found = sorted(row.marginal.items(), key=lambda item: -item[1].estimate)
    said = [f"{component(one, 'attack', shown)} {signed(-by.estimate, 2)}" for one, by in found if by.estimate >= ADDED]
    return "; ".join(said) or f"no attack takes {ADDED:g} that the others together leave"


def _shown(board: Board) -> dict[str, Varying]:
    """The parameters that tell defences and victims apart."""
    return {kind: varying([row.attacks[0] for row in board.rows], kind) for kind in ("defense", "victim")}


def _columns(board: Board) -> list[Column[Row]]:
    shown, measure, contrast = _shown(board), board.track.metric_title, board.track.contrast
    columns: list[Column[Row]] = [
        Column("rank", lambda row: f"{FLAGGED} {row.group}" if row.flagged else str(row.group)),
        Column("defence", lambda row: component(row.attacks[0], "defense", shown["defense"]), "left", folds=True),
        Column("victim", lambda row: component(row.attacks[0], "victim", shown["victim"]), "left", folds=True),
        Column(f"{measure}\nworst [95 %]", lambda row: estimate(row.worst.score, style=ATTACKED), "left"),
        *_failures(board.track),
        *_measures(board),
        Column("worst\ncell", lambda row: number(row.worst.worst_cell[1].estimate, 2)),
        Column("\n ", lambda row: Text(cell_name(row.worst.worst_cell[0]), style="dim"), "left", spare=2),
        Column("\nclean", lambda row: estimate(row.worst.clean, style=CLEAN), "left", spare=3),
    ]
    if any(row.worst.certified is not None for row in board.rows):
        columns.append(Column("certi-\nfied", lambda row: number(row.worst.certified, 2)))
    if contrast and contrast.side == "victim":
        columns.append(Column(contrast.short, lambda row: verdict(row.worst.lead)))
    return [
        *columns,
        Column("strongest\nattack", lambda row: str(row.identity["attack"]), "left"),
        Column("flags", _fired),
        Column(
            axis(measure),
            lambda row: strip({ATTACKED: row.worst.score, CLEAN: row.worst.clean}, STRIP),
            "left",
            spare=9,
        ),
    ]


def _failures(track: Track) -> list[Column[Row]]:
    """How often the victim fails under the strongest attack."""
    measure = next((one for one in track.measures if one.column == track.failure), None)
    if measure is None:
        return []
    return [Column(measure.heading, lambda row: share(row.worst.failure.estimate if row.worst.failure else None))]


def _measures(board: Board) -> list[Column[Row]]:
    """The ranked measures that some record has, under the attack that is the strongest in most cells."""
    measures = [one for one in board.track.measures if one.ranked]
    return [
        Column(one.heading, lambda row, one=one: str(written(one, row.attacks[0].measured(one))), spare=one.spare)  # type: ignore[misc]
        for one in measures
        if any(not math.isnan(row.attacks[0].measured(one).estimate) for row in board.rows)
    ]


def _fired(row: Row) -> Text:
    count = sum(bool(flag.fired) for flag in row.flags)
    return Text(str(count), style="yellow") if count else Text("")
