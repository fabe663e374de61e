"""What each row of the leaderboard rests on, read from the published records: the directive `published-rows`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from cavbench.leaderboard.comparisons.naming import Varying, defended, varying
from cavbench.leaderboard.published import every_track
from cavbench.leaderboard.ranking.boards import Board, Row, read_boards

HEAD = ("row", "seeds", "cells x scenarios", "attacks", "flags")


class PublishedRowsDirective(SphinxDirective):
    """A table for each leaderboard: of each row the number of seeds, cells, scenarios and attacks, and the flags that fired.

    The content is a command line, so a reader of the plain Markdown sees what to type.
    """

    has_content = True

    def run(self) -> list[nodes.Node]:
        for file in (Path(self.env.srcdir).parent / "leaderboard").rglob("*.parquet"):
            self.env.note_dependency(file)
        return self.parse_text_to_nodes(tables(read_boards(every_track())[0]))


def tables(boards: Sequence[Board]) -> str:
    """The tables in Markdown, the boards in the order of the leaderboard."""
    return "\n\n".join("\n".join(_table(board)) for board in boards)


def _table(board: Board) -> Iterator[str]:
    norm, budget, access, *_ = board.threat
    title = f"**{board.track.name.capitalize()}**: world `{board.world[0]}`, grid `{board.grid}`"
    yield f"{title}, norm `{norm}`, budget {budget:g}, access `{access}`."
    yield ""
    yield f"| {' | '.join(HEAD)} |"
    yield "|---" * len(HEAD) + "|"
    best = [row.attacks[0] for row in board.rows]
    shown = {kind: varying(best, kind) for kind in ("victim", "defense")}
    for row in board.rows:
        yield f"| {' | '.join(_cells(row, shown))} |"


def _cells(row: Row, shown: dict[str, Varying]) -> tuple[str, ...]:
    cells, scenarios = row.worst.shape
    return (
        defended(row.attacks[0], shown),
        str(len(row.worst.runs)) if row.worst.trained else "none",
        f"{cells} x {scenarios}",
        f"{len(row.attacks)}: {', '.join(sorted({str(one.identity['attack']) for one in row.attacks}))}",
        ", ".join(flag.name for flag in row.flags if flag.fired),
    )
