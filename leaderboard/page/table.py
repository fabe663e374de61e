"""The rows of a document as tables for other tools: `leaderboard.csv` and `leaderboard.tex`, and those of a run."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from typing import Any

from cavbench.errors import plain
from cavbench.latex import booktabs, escaped, estimate

BOARD = ("track", "world", "grid", "threat_norm", "threat_budget", "threat_access", "threat_queries", "threat_share")
"""The columns of the CSV that say which leaderboard a row is on; those of the row follow (`ranking.columns`)."""
ESTIMATES = ("score", "clean", "failed", "lead")
"""What a pair has an interval of."""
PAIRS = (
    *("role", "attack", "defense", "victim", "world", "track", "grid"),
    *("threat_norm", "threat_budget", "threat_access", "threat_queries", "threat_share"),
    *(f"{name}{end}" for name in ESTIMATES for end in ("", "_low", "_high")),
    *("kept", "queries", "training_seeds", "cells", "scenarios", "pair"),
)
"""The columns of the CSV of a run."""


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


def pairs_table(made: Mapping[str, Any]) -> str:
    """The pairs of a run as CSV: an interval takes three columns, a parameter of a component none of its own."""
    out = io.StringIO()
    writer = csv.DictWriter(out, PAIRS, lineterminator="\n")
    writer.writeheader()
    for one in made["pairs"]:
        line = {name: one[name] for name in ("role", "track", "grid", "kept", "queries")}
        line |= {kind: one[kind]["label"] for kind in ("attack", "defense", "victim")} | {"world": one["world"]["name"]}
        line |= {f"threat_{name}": value for name, value in one["threat"].items() if f"threat_{name}" in PAIRS}
        for name in ESTIMATES:
            found = one[name] or {}
            line |= zip(_ends(name), (found.get(end) for end in ("estimate", "low", "high")), strict=True)
        line |= {"training_seeds": " ".join(map(str, one["card"]["training_seeds"])), "cells": len(one["cells"])}
        line |= {"scenarios": one["scenarios"], "pair": one["card"]["pair"]}
        writer.writerow({name: cell(value) for name, value in line.items()})
    return out.getvalue()


def pairs_latex(made: Mapping[str, Any]) -> str:
    """The pairs of a run as LaTeX: a table a track, for the package booktabs."""
    return "\n".join(_pairs_tabular(made, name) for name in made["tracks"])


def _pairs_tabular(made: Mapping[str, Any], track: str) -> str:
    said = made["tracks"][track]
    heads = ["Victim", "Defence", "Attack", said["title"].capitalize()]
    columns = [{"kind": "number", "digits": 2, "interval": True}]
    failure = said["failure_title"].capitalize()
    lines = []
    for one in (one for one in made["pairs"] if one["track"] == track):
        names = [escaped(one[kind]["label"]) for kind in ("victim", "defense", "attack")]
        kept = "" if one["kept"] is None else f"{one['kept']:.2f}"
        failed = [_written(one["failed"], columns[0])] if failure else []
        lines.append([*names, _written(one["score"], columns[0]), kept, *failed])
    heads = [*heads, "Kept", *([failure] if failure else [])]
    return booktabs(f"{track}: mean and 95 % interval", "lll" + "r" * (len(heads) - 3), heads, lines)


def _ends(name: str) -> list[str]:
    return [name, f"{name}_low", f"{name}_high"]


def _names(column: Mapping[str, Any]) -> list[str]:
    name = column["name"]
    return _ends(name) if column["interval"] else [name]


def latex(made: Mapping[str, Any]) -> str:
    """The ranked rows of a document as LaTeX: a table a leaderboard, also over worlds, for the package booktabs."""
    return "\n".join([*(_tabular(board) for board in made["boards"]), worlds_latex(made)])


OVER_WORLDS = (
    *("track", *BOARD[3:], "rank", "defense", "victim", "trained_in"),
    *("mean", "mean_low", "mean_high", "worst_world", "world", "grid", "share", "score", "score_low", "score_high"),
    *("blind", "perfect", "training_seeds", "cells", "scenarios", "lacks"),
)
"""The columns of the CSV of leaderboards over worlds: a line a row and world."""


def worlds_table(made: Mapping[str, Any]) -> str:
    """The leaderboards over worlds as CSV: a line for each row in each world that counts or that it was driven in."""
    out = io.StringIO()
    writer = csv.DictWriter(out, OVER_WORLDS, lineterminator="\n")
    writer.writeheader()
    for board in made["worlds"]:
        of_board = {"track": board["track"]}
        of_board |= {f"threat_{name}": value for name, value in board["threat"].items()}
        for row in board["rows"]:
            of_row = of_board | {name: row[name] for name in ("rank", "defense", "victim", "trained_in")}
            of_row |= zip(_ends("mean"), _bounds(row["mean"]), strict=True)
            of_row["worst_world"] = (row["worst_world"] or {}).get("name")
            for world in board["worlds"]:
                name = world["name"]
                line = of_row | {"world": name, "grid": world["grid"], "lacks": row["lacks"].get(name, "")}
                place = row["worlds"].get(name)
                if place:
                    line |= {key: place[key] for key in ("share", "blind", "perfect", "cells", "scenarios")}
                    line |= zip(_ends("score"), _bounds(place["score"]), strict=True)
                    line["training_seeds"] = " ".join(map(str, place["training_seeds"]))
                writer.writerow({key: cell(value) for key, value in line.items()})
    return out.getvalue()


def worlds_latex(made: Mapping[str, Any]) -> str:
    """The leaderboards over worlds as LaTeX: a table each, with the shares of the worlds; scores where there are none."""
    return "\n".join(_worlds_tabular(board) for board in made["worlds"])


def _worlds_tabular(board: Mapping[str, Any]) -> str:
    threat, names = board["threat"], [world["name"] for world in board["worlds"]]
    shown = "share" if any(row["rank"] for row in board["rows"]) else "score"
    column = {"kind": "number", "digits": 2}
    lines = []
    for row in board["rows"]:
        worst = row["worst_world"] or {"share": None, "name": ""}
        places = [(row["worlds"].get(name) or {}).get(shown) for name in names]
        values = [row["rank"] and str(row["rank"]), row["name"], row["mean"], worst["share"], worst["name"], *places]
        lines.append([_written(value, column) for value in values])
    heads = [*map(escaped, ("Rank", "Victim", "Mean over worlds", "Worst world", "In", *names))]
    title = f"{board['track']} over worlds: {threat['norm']} {threat['budget']:g}, access {threat['access']}"
    return booktabs(f"{title}, {threat['queries']} queries", "rlrrl" + "r" * len(names), heads, lines)


def _bounds(found: Mapping[str, Any] | None) -> list[Any]:
    return [(found or {}).get(end) for end in ("estimate", "low", "high")]


def _tabular(board: Mapping[str, Any]) -> str:
    threat = board["threat"]
    listed = [column for column in board["columns"] if column["shown"]]
    title = f"{board['track']}, {board['grid']}: {threat['norm']} {threat['budget']:g}, access {threat['access']}"
    lines = [[_written(row["values"][column["name"]], column) for column in listed] for row in board["rows"]]
    kinds = "".join("l" if column["kind"] == "text" else "r" for column in listed)
    heads = [escaped(column["title"]) for column in listed]
    return booktabs(f"{title}, {threat['queries']} queries", kinds, heads, lines)


def _written(value: Any, column: Mapping[str, Any]) -> str:
    """A value; an interval small behind its estimate."""
    if value is None:
        return ""
    if isinstance(value, str):
        return escaped(value)
    digits = column["digits"]
    if not isinstance(value, dict):
        return f"{value:.{digits}f}"
    return estimate(value["estimate"], value["low"], value["high"], digits)


def cell(value: object) -> object:
    """A cell of a table: a text that a spreadsheet would take for a formula begins with an apostrophe; numbers stay numbers."""
    if not isinstance(value, str):
        return value
    formula = value.startswith(("=", "+", "-", "@", "\t", "\r"))
    return ("'" if formula else "") + plain(value)
