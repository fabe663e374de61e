"""The leaderboard over worlds on the terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import pyarrow as pa
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from cavbench.errors import UserError
from cavbench.leaderboard.ranking.methods import Method
from cavbench.leaderboard.ranking.published_worlds import read_worlds
from cavbench.leaderboard.ranking.worlds import WorldBoard, WorldRow
from cavbench.leaderboard.terminal.layout import Column, Section, fitted
from cavbench.leaderboard.terminal.text import ATTACKED, MISSING, allowance, estimate, number, of_frames

MINE = "▸"
SHARE = (
    "A share of 0 is the best blind policy of the world, 1 is perfect information; mean over the worlds, and the lowest. "
    "Rows of one rank are not told apart from its first."
)
SCORES = "Scores under the strongest attacks; this track has no references, so there is no mean over worlds."
"""What stands under the table."""


def worlds_report(records: Mapping[str, pa.Table], console: Console) -> None:
    """Print the ranking over worlds of every threat model.

    Args:
        records: by track (`cavbench.records.schema`); where there are none, the published records count.
        console: where to print.

    Raises:
        UserError: if no defended victim was attacked in two worlds.
    """
    found = read_worlds(records)
    if not found:
        raise UserError(
            "no defended victim was attacked in two worlds under the same threat model; drive it in another one with world="
        )
    print_worlds(found, console)


def print_worlds(boards: Sequence[WorldBoard], console: Console) -> None:
    """Print the leaderboards over worlds."""
    for board in boards:
        norm, budget, access, queries, frames = board.threat
        allowed = f", {allowance(norm, budget)}, access {access}, {queries} queries{of_frames(frames)}"
        console.print(Padding(Text.assemble((f"{board.track.name} over worlds", "bold"), allowed), (1, 1)))
        console.print(Padding(fitted(_columns(board), [Section(board.rows)], console), (0, 1)))
        ranked = any(row.group for row in board.rows)
        console.print(Padding(Text(SHARE if ranked else SCORES, style="dim"), (0, 1)))
        for line in notes(board):
            console.print(Padding(Text(line, style="yellow"), (0, 1)))
        console.print()


def notes(board: WorldBoard) -> list[str]:
    """Why worlds do not count, a line each, and why rows have no rank."""
    if board.track.perfect == "":
        return []
    found = [f"{name} does not count: {why}" for name, why in board.without_scale.items()]
    for row in board.rows:
        reasons: dict[str, list[str]] = {}
        for world, why in row.lacks.items():
            reasons.setdefault(why, []).append(world)
        if reasons:
            listed = "; ".join(f"{', '.join(worlds)}: {why}" for why, worlds in reasons.items())
            found.append(f"{title(row.method)} has no rank. {listed}")
    return found


def title(method: Method) -> str:
    """A defended victim in one text."""
    named = method.victim if method.defense == "none" else f"{method.defense} + {method.victim}"
    return f"{named}, {method.trained}" if method.trained else named


def _columns(board: WorldBoard) -> list[Column[WorldRow]]:
    scale = any(row.group for row in board.rows)
    homes = any(row.method.home for row in board.rows)
    columns: list[Column[WorldRow]] = [
        Column("\ndefence", lambda row: row.method.defense, "left", folds=True),
        Column("\nvictim", lambda row: row.method.victim, "left", folds=True),
    ]
    if homes:
        columns.append(Column("trained\nin", lambda row: row.method.home, "left", spare=1))
    if scale:
        columns = [
            Column("\nrank", _rank),
            *columns,
            Column("mean over\nworlds [95 %]", lambda row: estimate(row.mean, style=ATTACKED), "left"),
            Column("worst\nworld", lambda row: MISSING if row.worst is None else number(row.worst[1], 2)),
            Column("\nin", lambda row: "" if row.worst is None else Text(row.worst[0], style="dim"), "left", spare=2),
        ]
    worlds = (Column(f"\n{name}", _value(name, scale), spare=3 if scale else 0) for name in board.grids)
    return [*columns, *worlds]


def _rank(row: WorldRow) -> str:
    return f"{MINE * row.method.mine} {row.group or MISSING}".lstrip()


def _value(world: str, scale: bool) -> Callable[[WorldRow], str]:
    """The share of a row in a world; its score where the track has no scale."""

    def value(row: WorldRow) -> str:
        place = row.places.get(world)
        if place is None:
            return ""
        return number(place.share if scale else place.worst.score.estimate, 2)

    return value
