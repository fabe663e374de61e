"""`leaderboard.csv`: a line a ranked row."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from typing import Any

from cavbench.errors import plain

CSV = (
    "track", "world", "grid", "threat_norm", "threat_budget", "threat_access", "threat_queries", "threat_share",
    "group", "flagged", "flags",
    "defense", "defense_params", "victim", "victim_params", "score", "low", "high", "failed", "failed_low", "failed_high",
    "worst_cell", "worst_cell_score", "worst_cell_low", "worst_cell_high", "clean", "clean_low", "clean_high", "certified",
    "lead", "lead_low", "lead_high", "strongest_attack", "strongest_attack_params", "training_seeds", "cells", "scenarios",
    "remarks",
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
            threat = board["threat"]
            line = {
                "track": board["track"],
                "world": board["world"]["name"],
                "grid": board["grid"],
                "worst_cell": json.dumps(row["worst_cell"]["cell"]),
                **{f"threat_{name}": threat[name] for name in ("norm", "budget", "access", "queries", "share")},
                "group": row["group"],
                "flagged": str(row["flagged"]).lower(),
                "flags": " ".join(flag["name"] for flag in row["flags"] if flag["fired"]),
                "strongest_attack": strongest["name"],
                "strongest_attack_params": json.dumps(strongest["params"], sort_keys=True),
                "training_seeds": " ".join(map(str, row["training_seeds"])),
                "certified": row["certified"],
                "cells": len(row["cells"]),
                "scenarios": row["scenarios"],
                "remarks": " ".join(one["name"] for one in row["remarks"]),
            }
            for kind in ("defense", "victim"):
                line |= {kind: row[kind]["name"], f"{kind}_params": json.dumps(row[kind]["params"], sort_keys=True)}
            for name in ("score", "failed", "worst_cell", "clean", "lead"):
                found = row[name] or dict.fromkeys(("estimate", "low", "high"))
                prefix = "" if name == "score" else f"{name}_"
                value = "worst_cell_score" if name == "worst_cell" else name
                line |= {value: found["estimate"], f"{prefix}low": found["low"], f"{prefix}high": found["high"]}
            writer.writerow({name: cell(value) for name, value in line.items()})
    return out.getvalue()


def cell(value: object) -> object:
    """A cell of a table: a text that a spreadsheet would take for a formula begins with an apostrophe; numbers stay numbers."""
    if not isinstance(value, str):
        return value
    formula = value.startswith(("=", "+", "-", "@", "\t", "\r"))
    return ("'" if formula else "") + plain(value)
