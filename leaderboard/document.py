"""`leaderboard.json` and `leaderboard.csv`: the leaderboards for other tools, and what the page shows."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from bench.plugins.contracts import Track
from bench.scenarios import Cell
from bench.statistics.episodes import Episodes, rate, unit_interval
from bench.statistics.estimates import Array, Interval, interval, task_intervals
from leaderboard.cards import card
from leaderboard.entries import METRICS, Aligned, Entry, align
from leaderboard.flags import FLAGS, budgets, efforts
from leaderboard.pairs import parameters
from leaderboard.ranking import Board, Row
from leaderboard.text import labels

VERSION = 1
"""Of the schema; a reader that knows it can read every later document of the same version."""
Labels = Mapping[str, Mapping[tuple[object, object], str]]
"""What a component is called: by its kind, then by its name and parameters."""


def schema() -> dict[str, Any]:
    """The JSON schema (draft 2020-12) of a document."""
    text = (files("leaderboard") / "data" / "leaderboard.schema.json").read_text(encoding="utf-8")
    return dict(json.loads(text))


def document(boards: Sequence[Board], entries: Sequence[Entry], folder: Path | None) -> dict[str, Any]:
    """Everything that leaderboards say, as JSON values.

    Args:
        boards: the leaderboards.
        entries: all that was driven.
        folder: the results folder; None where records are published.
    """
    everything = [*entries, *_controls(entries)]
    driven = [(entry, entry.own.table.num_rows) for entry in everything]
    called = {kind: labels(driven, kind) for kind in ("attack", "defense", "victim")}
    keys = {id(entry): key for key, entry in enumerate(everything)}
    return {
        "schema": VERSION,
        "cavbench": metadata.version("cavbench"),
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "metrics": dict(METRICS),
        "boards": [_board(board, keys, called) for board in boards],
        "pairs": [_pair(entry, keys[id(entry)], called, folder) for entry in everything],
        "curves": [
            _curve(family, kind, aligned, keys) for kind, family in _families(entries) if (aligned := align(family))
        ],
    }


def _controls(entries: Sequence[Entry]) -> list[Entry]:
    """Of every defended victim that was attacked, the same without an attack: the one that was driven most."""
    found: dict[tuple[object, ...], Entry] = {}
    for entry in entries:
        if entry.attacked and entry.control:
            (identity,) = entry.control.table.select(list(entry.identity)).slice(0, 1).to_pylist()
            control = Entry(entry.track, identity, entry.control, entry.clean, entry.references)
            known = found.get(entry.defended)
            if known is None or known.own.table.num_rows < control.own.table.num_rows:
                found[entry.defended] = control
    return list(found.values())


def _families(entries: Sequence[Entry]) -> list[tuple[str, list[Entry]]]:
    """Attacks that were run with several budgets, and with several efforts."""
    attacked = [entry for entry in entries if entry.attacked]
    return [
        *(("budget", family) for family in budgets(attacked)),
        *(("queries", family) for family in efforts(attacked)),
    ]


def _curve(family: Sequence[Entry], kind: str, aligned: Aligned, keys: Mapping[int, int]) -> dict[str, Any]:
    """On the scenarios that all points have."""
    known = (entry.control for entry in family if entry.control)
    control = next((one for one in known if set(aligned.cells) <= set(one.cells)), None)
    return {
        "kind": kind,
        "cells": len(aligned.cells),
        "clean": _interval(unit_interval(control.only(cells=aligned.cells).column(family[0].metric)))
        if control
        else None,
        "points": [
            {
                "x": entry.queries if kind == "queries" else entry.identity["threat_budget"],
                **(_interval(unit_interval(scores)) or {}),
                "pair": keys[id(entry)],
            }
            for entry, scores in zip(family, aligned.scores, strict=True)
        ],
    }


def _board(board: Board, keys: Mapping[int, int], called: Labels) -> dict[str, Any]:
    return {
        "track": board.track,
        "world": {"name": board.world[0], "params": parameters(board.world[1])},
        "threat": _threat(board.threat),
        "rows": [_row(row, keys, called) for row in board.rows],
        "references": [
            {
                "name": name,
                "score": _interval(unit_interval(drive.column(METRICS[board.track]))),
                "cells": _cells(drive.cells, drive.column(METRICS[board.track])),
            }
            for name, drive in board.references.items()
        ],
    }


def _threat(values: Sequence[object]) -> dict[str, object]:
    return dict(zip(("norm", "budget", "access", "queries"), values, strict=True))


def _row(row: Row, keys: Mapping[int, int], called: Labels) -> dict[str, Any]:
    worst = row.worst
    cells = _cells(worst.cells, worst.scores)
    for cell, entry, blind in zip(cells, worst.attacks, worst.blind, strict=True):
        cell |= {"pair": keys[id(entry)], "blind": _number(float(blind.mean()))}
    return {
        "group": row.group,
        "flagged": row.flagged,
        **_named(row.entries[0], ("defense", "victim"), called),
        "score": _interval(worst.score),
        "clean": _interval(row.clean),
        "lead": _interval(worst.lead),
        "strongest": keys[id(row.entries[0])],
        "pairs": [keys[id(entry)] for entry in row.entries],
        "training_seeds": list(worst.runs),
        "scenarios": worst.scores.shape[2],
        "cells": cells,
        "flags": [
            {"name": flag.name, "title": FLAGS[flag.name][0], "fired": flag.fired, "reason": flag.reason}
            for flag in row.flags
        ],
    }


def _named(entry: Entry, kinds: Sequence[str], called: Labels) -> dict[str, Any]:
    return {
        kind: {
            "name": entry.identity[kind],
            "label": called[kind][entry.identity[kind], entry.identity[f"{kind}_params"]],
            "params": parameters(entry.identity[f"{kind}_params"]),
        }
        for kind in kinds
    }


def _pair(entry: Entry, key: int, called: Labels, folder: Path | None) -> dict[str, Any]:
    own, identity = entry.own, entry.identity
    cells = _cells(own.cells, entry.scores)
    for name in ("crashed" if entry.track == "driving" else "ran", "queries"):
        for cell, value in zip(cells, own.column(name).mean((0, 2)).tolist(), strict=True):
            cell[name] = _number(value)
    return {
        "key": key,
        "track": entry.track,
        **_named(entry, ("attack", "defense", "victim"), called),
        "world": {"name": identity["world"], "params": parameters(identity["world_params"])},
        "threat": _threat([identity[f"threat_{name}"] for name in ("norm", "budget", "access", "queries")]),
        "asks": entry.knowledge if entry.attacked else "nothing",
        "score": _interval(entry.score),
        "clean": _interval(entry.clean_score),
        "queries": _number(entry.queries),
        "measures": _measures(entry.track, own),
        "cells": cells,
        "card": card(entry, folder),
    }


def _measures(track: Track, own: Episodes) -> dict[str, dict[str, Any] | None]:
    """What is shown beside the ranking metric."""
    if track == "driving":
        return {"return": _interval(interval(own.column("return"))), "crashed": _interval(rate(own, "crashed"))}
    return {"detected": _interval(unit_interval(own.column("detection_rate"))), "ran": _interval(rate(own, "ran"))}


def _cells(cells: Sequence[Cell], scores: Array) -> list[dict[str, Any]]:
    """Each cell's estimate and interval, and what every run got there, so that a reader can average over some of them."""
    means = scores.mean(2)
    errors = scores[0].std(1) / np.sqrt(scores.shape[2])
    return [
        {
            "weather": cell.weather,
            "lanes": cell.lanes,
            "density": cell.density,
            **(_interval(found) or {}),
            "runs": [_number(value) for value in means[:, place].tolist()],
            "error": _number(float(errors[place])),
        }
        for place, (cell, found) in enumerate(zip(cells, task_intervals(scores), strict=True))
    ]


def _interval(found: Interval | None) -> dict[str, Any] | None:
    if found is None:
        return None
    return {"estimate": _number(found.estimate), "low": _number(found.low), "high": _number(found.high)}


def _number(value: float) -> float | None:
    """Four digits behind the point; null where there is no number."""
    return round(value, 4) if np.isfinite(value) else None


CSV = (
    "track", "world", "threat_norm", "threat_budget", "threat_access", "threat_queries", "group", "flagged", "flags",
    "defense", "defense_params", "victim", "victim_params", "score", "low", "high", "clean", "clean_low", "clean_high",
    "lead", "lead_low", "lead_high", "strongest_attack", "strongest_attack_params", "training_seeds", "cells", "scenarios",
)  # fmt: skip
"""The columns of `leaderboard.csv`, a line a ranked row."""


def table(made: Mapping[str, Any]) -> str:
    """The ranked rows of a document as CSV."""
    out = io.StringIO()
    writer = csv.DictWriter(out, CSV, lineterminator="\n")
    writer.writeheader()
    pairs = {pair["key"]: pair for pair in made["pairs"]}
    for board in made["boards"]:
        for row in board["rows"]:
            strongest = pairs[row["strongest"]]["attack"]
            line = {
                "track": board["track"],
                "world": board["world"]["name"],
                **{f"threat_{name}": value for name, value in board["threat"].items()},
                "group": row["group"],
                "flagged": str(row["flagged"]).lower(),
                "flags": " ".join(flag["name"] for flag in row["flags"] if flag["fired"]),
                "strongest_attack": strongest["name"],
                "strongest_attack_params": json.dumps(strongest["params"], sort_keys=True),
                "training_seeds": " ".join(map(str, row["training_seeds"])),
                "cells": len(row["cells"]),
                "scenarios": row["scenarios"],
            }
            for kind in ("defense", "victim"):
                line |= {kind: row[kind]["name"], f"{kind}_params": json.dumps(row[kind]["params"], sort_keys=True)}
            for name in ("score", "clean", "lead"):
                found = row[name] or dict.fromkeys(("estimate", "low", "high"))
                prefix = "" if name == "score" else f"{name}_"
                line |= {name: found["estimate"], f"{prefix}low": found["low"], f"{prefix}high": found["high"]}
            writer.writerow(line)
    return out.getvalue()
