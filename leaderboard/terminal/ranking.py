"""The ranking of every threat model on the terminal, of defended victims and of attacks; and why rows are flagged."""

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
from cavbench.leaderboard.ranking.published_worlds import published_worlds
from cavbench.leaderboard.ranking.worlds import over_several
from cavbench.leaderboard.terminal.attackers import print_attackers
from cavbench.leaderboard.terminal.layout import STRIP, Column, Section, axis, fitted
from cavbench.leaderboard.terminal.text import (
    ATTACKED,
    BASELINE,
    CLEAN,
    MISSING,
    allowance,
    counted,
    estimate,
    number,
    of_frames,
    share,
    signed,
    strip,
    verdict,
)
from cavbench.leaderboard.terminal.worlds import print_worlds
from cavbench.statistics.estimates import Interval, share_interval

ADDED = 0.01
"""What an attack must add to be named."""


def leaderboard_report(records: Mapping[str, pa.Table], console: Console) -> None:
    """Print the ranking of defended victims in every threat model, and that of the attacks on them.

    Args:
        records: by track (`cavbench.records.schema`); where there are none, the published records count.
        console: where to print.
    """
    boards = read_boards(records or every_track())[0]
    print_boards(boards, console)
    print_worlds(over_several(boards) if records else published_worlds(boards), console)


def beside_report(records: Mapping[str, pa.Table], console: Console) -> None:
    """Print the same ranking with the published rows beside those of the records, which are marked.

    Args:
        records: as of `leaderboard_report`; there must be some.
        console: likewise.

    Raises:
        UserError: if nothing was attacked.
    """
    boards = read_boards(records, every_track(worlds=True))[0]
    print_boards(boards, console)
    print_worlds(over_several(boards), console)


def flags_report(records: Mapping[str, pa.Table], console: Console) -> None:
    """Print why each row of the ranking is flagged, what each attack adds, and what else a reader must know of it.

    Args:
        records: as of `leaderboard_report`.
        console: likewise.
    """
    for board in read_boards(records or every_track())[0]:
        console.print(Padding(_title(board), (1, 1, 0, 1)))
        for row in board.rows:
            console.print(Padding(Text(_name(row, board), style="bold"), (1, 1, 0, 1)))
            for line in _said(row):
                console.print(Padding(line, (0, 3)))
    console.print()


def _said(row: Row) -> Iterator[Text]:
    """What there is to say of a row, a line each."""
    for flag in row.flags:
        if flag.fired:
            yield Text.assemble((f"{FLAGGED} {FLAGS[flag.name][0]}: ", "yellow"), flag.reason)
    if len(row.attacks) > 1:
        yield Text.assemble(("added: ", "dim"), _added(row))
    for remark in row.remarks:
        yield Text.assemble(("note: ", "dim"), remark.text)


def print_boards(boards: Sequence[Board], console: Console) -> None:
    """Print the leaderboard of each threat model."""
    for board in boards:
        console.print(Padding(_title(board), (1, 1)))
        console.print(Padding(fitted(_columns(board), _sections(board), console), (0, 1)))
        mine = _of_mine(board)
        flagged = BELOW if any(row.flagged for row in board.rows) else ""
        console.print(Padding(Text(mine + flagged + SHARED, style="dim"), (0, 1)))
        for line in _without_rank(board):
            console.print(Padding(Text(line, style="yellow"), (0, 1)))
        for name, drive in board.baselines.items():
            score = estimate(share_interval(drive.column(board.track.metric)), style=BASELINE)
            console.print(Padding(Text.assemble(f"{name}: ", score), (0, 3)))
        console.print()
        print_attackers(board, console)
    console.print()


def _without_rank(board: Board) -> Iterator[str]:
    """Why rows have no rank: a line for each that does nothing, and one for all with one patch."""
    if alone := sum(row.one_patch and not row.hopeless for row in board.rows):
        yield f"{counted(alone, 'row')} of one patch without a rank: another patch may take more or less"
    for row in board.rows:
        if row.hopeless:
            yield from (f"{_name(row, board)}: {one.text}" for one in row.remarks if one.name == "hopeless")


def _title(board: Board) -> Text:
    norm, budget, access, queries, frames = board.threat
    allowed = f"{board.grid}, {allowance(norm, budget)}, access {access}, {queries} queries{of_frames(frames)}"
    return Text.assemble((board.track.name, "bold"), f" in {board.world[0]}, {allowed}")


FLAGGED, MINE = "⚑", "▸"
BELOW = f"{FLAGGED} number of flags: a flagged row ranks below all rows without one; `bench report flags` says why. "
SHARED = "Rows of one rank are not told apart from its first."
"""What stands under a ranking, so that its order is understood."""


def _of_mine(board: Board) -> str:
    """What a mark means, and that there is nothing to compare with."""
    if not any(row.mine for row in board.rows):
        return ""
    alone = "no published row was driven in this threat model and world. " * all(row.mine for row in board.rows)
    return f"{MINE} your rows; {alone}" if alone else f"{MINE} your rows. "


def _sections(board: Board) -> list[Section[Row]]:
    """The rows without a flag, then the others."""
    parts = ([row for row in board.rows if row.flagged is flagged] for flagged in (False, True))
    return [Section(part) for part in parts if part]


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
            return f"{MINE * row.mine}{FLAGGED * row.flagged} {place}".lstrip()
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
