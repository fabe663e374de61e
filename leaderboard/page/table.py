"""The ranked rows of a document as tables for other tools: `leaderboard.csv` and `leaderboard.tex`."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from cavbench.errors import plain

BOARD = ("track", "world", "grid", "threat_norm", "threat_budget", "threat_access", "threat_queries", "threat_share")
"""The columns of the CSV that say which leaderboard a row is on; those of the row follow (`ranking.columns`)."""
SPECIAL = {
    **{letter: f"\\{letter}" for letter in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "×": r"$\times$",
    "−": "$-$",
}
"""What LaTeX writes for a letter that means something to it."""


def table(made: Mapping[str, Any]) -> str:
    """The ranked rows of a document as CSV: an interval takes three columns."""
    listed = {column["name"]: column for board in made["boards"] for column in board["columns"]}
    out = io.StringIO()
    writer = csv.DictWriter(
        out, [*BOARD, *(name for one in listed.values() for name in _names(one))], lineterminator="\n"
    )
    writer.writeheader()
    for board in made["boards"]:
        of_board = {"track": board["track"], "world": board["world"]["name"], "grid": board["grid"]}
        of_board |= {f"threat_{name}": value for name, value in board["threat"].items() if f"threat_{name}" in BOARD}
        for row in board["rows"]:
            line = dict(of_board)
            for column in board["columns"]:
                value = row["values"][column["name"]]
                ends = (
                    [(value or {}).get(end) for end in ("estimate", "low", "high")] if column["interval"] else [value]
                )
                line |= zip(_names(column), ends, strict=True)
            writer.writerow({name: cell(value) for name, value in line.items()})
    return out.getvalue()


def _names(column: Mapping[str, Any]) -> list[str]:
    name = column["name"]
    return [name, f"{name}_low", f"{name}_high"] if column["interval"] else [name]


def latex(made: Mapping[str, Any]) -> str:
    """The ranked rows of a document as LaTeX: a table a leaderboard, for the package booktabs."""
    return "\n".join(_tabular(board) for board in made["boards"])


def _tabular(board: Mapping[str, Any]) -> str:
    threat = board["threat"]
    listed = [column for column in board["columns"] if column["shown"]]
    title = f"{board['track']}, {board['grid']}: {threat['norm']} {threat['budget']:g}, access {threat['access']}"
    lines = [[_written(row["values"][column["name"]], column) for column in listed] for row in board["rows"]]
    return "\n".join(
        (
            f"% {plain(title)}, {threat['queries']} queries",
            f"\\begin{{tabular}}{{{''.join('l' if column['kind'] == 'text' else 'r' for column in listed)}}}",
            r"\toprule",
            _line([_escaped(column["title"]) for column in listed]),
            r"\midrule",
            *map(_line, lines),
            r"\bottomrule",
            r"\end{tabular}",
            "",
        )
    )


def _line(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"


def _written(value: Any, column: Mapping[str, Any]) -> str:
    """A value; an interval small behind its estimate."""
    if value is None:
        return ""
    if isinstance(value, str):
        return _escaped(value)
    digits = column["digits"]
    if not isinstance(value, dict):
        return f"{value:.{digits}f}"
    low, high = value["low"], value["high"]
    bounds = "" if low is None else rf" {{\scriptsize [{low:.{digits}f}, {high:.{digits}f}]}}"
    return f"{value['estimate']:.{digits}f}{bounds}"


def _escaped(text: str) -> str:
    return "".join(SPECIAL.get(letter, letter) for letter in plain(text))


def cell(value: object) -> object:
    """A cell of a table: a text that a spreadsheet would take for a formula begins with an apostrophe; numbers stay numbers."""
    if not isinstance(value, str):
        return value
    formula = value.startswith(("=", "+", "-", "@", "\t", "\r"))
    return ("'" if formula else "") + plain(value)
