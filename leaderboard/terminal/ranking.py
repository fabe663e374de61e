"""The ranking of every threat model on the terminal, with the flags that have fired."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import pyarrow as pa
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from cavbench.leaderboard.comparisons.comparison import Comparison
from cavbench.leaderboard.comparisons.naming import Varying, component, varying
from cavbench.leaderboard.published import every_track
from cavbench.leaderboard.ranking.boards import Board, Row, read_boards
from cavbench.leaderboard.ranking.columns import Called, columns
from cavbench.leaderboard.ranking.columns import Column as Ranked
from cavbench.leaderboard.ranking.flags import FLAGS
from cavbench.leaderboard.terminal.layout import STRIP, Column, Section, axis, fitted
from cavbench.leaderboard.terminal.text import (
    ATTACKED,
    BASELINE,
    CLEAN,
    MISSING,
    estimate,
    number,
    of_frames,
    share,
    signed,
    strip,
    verdict,
)
from cavbench.statistics.estimates import Interval, share_interval

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


STYLES = {"score": ATTACKED, "clean": CLEAN}
"""The columns that the terminal shows with their intervals, in the colours of the strip."""


def _columns(board: Board) -> list[Column[Row]]:
    """The columns of the ranking that have a heading for the terminal, and a strip."""
    shown = _shown(board)

    def called(one: Comparison, kind: str) -> str:
        return component(one, kind, shown[kind]) if kind in shown else str(one.identity[kind])

    return [
        *(_column(one, called) for one in columns(board) if one.short),
        Column(
            axis(board.track.metric_title),
            lambda row: strip({ATTACKED: row.worst.score, CLEAN: row.worst.clean}, STRIP),
            "left",
            spare=9,
        ),
    ]


def _column(one: Ranked, called: Called) -> Column[Row]:
    def shown(row: Row) -> Text | str:
        found = one.value(row, called)
        if one.name == "rank":
            place = MISSING if found is None else str(found)
            return f"{FLAGGED} {place}" if row.flagged else place
        if one.name == "flags":
            return _fired(row)
        if one.name in STYLES:
            return estimate(found if isinstance(found, Interval) else None, style=STYLES[one.name])
        if one.kind == "difference":
            return verdict(found if isinstance(found, Interval) else None)
        if isinstance(found, str):
            return Text(found, style="dim" if one.spare else "")
        value = found.estimate if isinstance(found, Interval) else found
        return share(value) if one.kind == "share" else number(value, one.digits)

    left = one.name in STYLES or (one.kind == "text" and one.name != "flags")
    return Column(
        one.short, shown, "left" if left else "right", spare=one.spare, folds=one.name in ("defense", "victim")
    )


def _fired(row: Row) -> Text:
    count = sum(bool(flag.fired) for flag in row.flags)
    return Text(str(count), style="yellow") if count else Text("")
