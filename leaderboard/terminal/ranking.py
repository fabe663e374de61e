"""The ranking of every threat model on the terminal, with the flags that have fired."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pyarrow as pa
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from bench.statistics.episodes import unit_interval
from leaderboard.comparisons.naming import component, varying
from leaderboard.ranking.boards import Board, Row, read_boards
from leaderboard.ranking.flags import FLAGS
from leaderboard.terminal.layout import STRIP, Column, Section, axis, fitted
from leaderboard.terminal.text import ATTACKED, BASELINE, CLEAN, estimate, strip, verdict


def leaderboard_report(records: Mapping[str, pa.Table], console: Console) -> None:
    """Print the ranking of every threat model, with the flags that have fired.

    Args:
        records: by track (`bench.records.schema`).
        console: where to print.
    """
    print_boards(read_boards(records)[0], console)


def print_boards(boards: Sequence[Board], console: Console) -> None:
    """Print the leaderboard of each threat model."""
    for board in boards:
        norm, budget, access, queries, share = board.threat
        frames = "" if share == 1 else f", {100 * share:g} % of the frames"
        allowed = f"{norm} {budget:g}, access {access}, {queries} queries{frames}"
        title = Text.assemble((board.track.name, "bold"), f" in {board.world[0]}, {allowed}")
        console.print(Padding(title, (1, 1)))
        console.print(Padding(fitted(_columns(board), [Section(board.rows)], console), (0, 1)))
        for name, drive in board.baselines.items():
            score = estimate(unit_interval(drive.column(board.track.metric)), style=BASELINE)
            console.print(Padding(Text.assemble(f"{name}: ", score), (0, 3)))
        for row in board.rows:
            if row.flagged:
                titles = "; ".join(FLAGS[flag.name][0] for flag in row.flags if flag.fired)
                said = Text.assemble(("flagged ", "yellow"), f"{_name(row, board)}: ", (titles, "dim"))
                console.print(Padding(said, (0, 1)))
    console.print()


def _name(row: Row, board: Board) -> str:
    shown = _shown(board)
    return " ".join(component(row.attacks[0], kind, shown[kind]) for kind in ("defense", "victim"))


def _shown(board: Board) -> dict[str, set[str]]:
    """The parameters that tell defences and victims apart."""
    return {kind: varying([row.attacks[0] for row in board.rows], kind) for kind in ("defense", "victim")}


def _columns(board: Board) -> list[Column[Row]]:
    shown, measure, contrast = _shown(board), board.track.metric_title, board.track.contrast
    columns: list[Column[Row]] = [
        Column("rank", lambda row: str(row.group)),
        Column("defence", lambda row: component(row.attacks[0], "defense", shown["defense"]), "left", folds=True),
        Column("victim", lambda row: component(row.attacks[0], "victim", shown["victim"]), "left", folds=True),
        Column(f"{measure}\nworst [95 %]", lambda row: estimate(row.worst.score, style=ATTACKED), "left"),
        Column("\nclean", lambda row: estimate(row.clean, style=CLEAN), "left", spare=3),
    ]
    if contrast and contrast.side == "victim":
        columns.append(Column(contrast.short, lambda row: verdict(row.worst.lead)))
    return [
        *columns,
        Column("strongest\nattack", lambda row: str(row.identity["attack"]), "left"),
        Column("flags", _fired),
        Column(axis(measure), lambda row: strip({ATTACKED: row.worst.score, CLEAN: row.clean}, STRIP), "left", spare=9),
    ]


def _fired(row: Row) -> Text:
    count = sum(bool(flag.fired) for flag in row.flags)
    return Text(str(count), style="yellow") if count else Text("")
