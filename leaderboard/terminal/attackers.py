"""The ranking of attacks on the terminal."""

from __future__ import annotations

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from cavbench.leaderboard.ranking.attackers import Attacker, attackers
from cavbench.leaderboard.ranking.boards import Board
from cavbench.leaderboard.terminal.layout import Column, Section, fitted
from cavbench.leaderboard.terminal.text import counted, number, share

MEANING = (
    "adds: how far the attack, in all its variants, lowers the score below that under all other attacks; mean over its rows. "
    "Queries and CPU seconds are those of all its variants."
)


def print_attackers(board: Board, console: Console) -> None:
    """Print the attacks of a leaderboard, the one that adds most first."""
    per_step = board.track.queries_title.endswith("per step")
    columns: list[Column[Attacker]] = [
        Column("\nrank", lambda one: str(one.group)),
        Column("\nattack", _name, "left", folds=True),
        Column("\nadds", lambda one: number(one.added, 2)),
        Column("alone\ntakes", lambda one: number(one.alone, 2)),
        Column("strongest\nin cells", lambda one: share(one.strongest)),
        Column(f"rows\nof {len(board.rows)}", lambda one: str(one.rows), spare=2),
        Column("queries\n/ step" if per_step else "\nqueries", lambda one: number(one.queries)),
        Column("CPU s\n/ episode", lambda one: number(one.seconds, 2 if one.seconds < 10 else 0)),
    ]
    console.print(Padding(Text("Attacks, by what they add", style="bold"), (0, 1)))
    console.print(Padding(fitted(columns, [Section(attackers(board))], console), (0, 1)))
    console.print(Padding(Text(MEANING, style="dim"), (0, 1)))


def _name(one: Attacker) -> Text:
    variants = f" ({counted(one.variants, 'variant')})" if one.variants > 1 else ""
    return Text.assemble(one.name, (variants, "dim"))
