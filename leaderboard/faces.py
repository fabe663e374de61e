"""The face of a row: what a reviewer reads in a pull request, computed from the row's records alone."""

from __future__ import annotations

import hashlib
import json
import math
import re
from pathlib import Path
from typing import Any

import pyarrow.compute as pc

from cavbench.files import whole
from cavbench.leaderboard.comparisons.comparison import parameters
from cavbench.leaderboard.comparisons.naming import component, varying
from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.records import reading
from cavbench.records.columns import track_of

NUMBERS = re.compile(r"\[[-\d.,\s]+\]")


def face(file: Path) -> dict[str, Any]:
    """What a row says: its score under the widest threat model that it was attacked in, and what that rests on.

    Rank and flags are left out: they depend on other rows.

    Args:
        file: the row's records, `GRID/NAME.parquet`.
    """
    records = reading.read_file(file)
    track = track_of(file)
    found, _ = read_boards({track.name: records})
    # The first has the largest budget and the most access.
    board = next(one for one in found if one.grid == file.parent.name)
    (row,) = board.rows
    worst, first = row.worst, row.attacks[0]
    norm, budget, access, queries, share = board.threat
    shown = varying(row.attacks, "attack")
    return {
        "name": file.stem,
        "track": track.name,
        "world": board.world[0],
        "grid": board.grid,
        **{
            kind: {"name": first.identity[kind], "params": parameters(first.identity[f"{kind}_params"])}
            for kind in ("victim", "defense")
        },
        "threat": {"norm": norm, "budget": budget, "access": access, "queries": queries, "share": share},
        "training_seeds": list(worst.runs),
        "cells": len(worst.cells),
        "scenarios": len(worst.panel.seeds),
        "attacks": [component(one, "attack", shown) for one in row.attacks],
        "score": _number(worst.score.estimate),
        "interval": [_number(worst.score.low), _number(worst.score.high)],
        "failed": _number(worst.failure.estimate) if worst.failure else None,
        "clean": _number(worst.clean.estimate) if worst.clean else None,
        "strongest_attack": component(first, "attack", shown),
        "code_digests": sorted(pc.unique(records["code_digest"]).to_pylist()),
        "records_sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
    }


def write_face(file: Path, home: Path) -> Path:
    """Write the face of a row to `rows/GRID/NAME.json`, and return that file.

    Args:
        file: the row's records.
        home: the folder with `rows`.
    """
    target = home / "rows" / file.parent.name / f"{file.stem}.json"
    target.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(face(file), indent=1)
    # Lists of numbers on one line: a reviewer reads a change as one line.
    text = NUMBERS.sub(lambda found: " ".join(found[0].split()).replace("[ ", "[").replace(" ]", "]"), text)
    with whole(target) as made:
        made.write(f"{text}\n".encode())
    return target


def _number(value: float) -> float | None:
    """Four digits behind the point; None where one training and one scenario have no interval."""
    return None if math.isnan(value) else round(value, 4)
