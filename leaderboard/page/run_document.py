"""What was driven, as JSON values: of a run, of a results folder, or of one pair with its controls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from cavbench.core.track import track
from cavbench.leaderboard.comparisons.baselines import identity_of
from cavbench.leaderboard.comparisons.comparison import Comparison, parameters
from cavbench.leaderboard.comparisons.naming import labels
from cavbench.leaderboard.comparisons.reading import read_comparisons
from cavbench.leaderboard.page.pairs import (
    Labels,
    Role,
    controls,
    describe_track,
    interval,
    named,
    number,
    pair,
    threat,
)
from cavbench.leaderboard.ranking.boards import Board, Row, boards
from cavbench.leaderboard.ranking.flags import FLAGS
from cavbench.leaderboard.ranking.remarks import run_remarks


def run_content(records: Mapping[str, pa.Table], folder: Path | None) -> dict[str, Any]:
    """Every pair, clean control and baseline of some records; of each defended victim the strongest attacks; and remarks.

    Args:
        records: by track (`cavbench.records.schema`).
        folder: the results folder, where recordings may be.
    """
    found = {track(name): read_comparisons(table, track(name)) for name, table in records.items()}
    everything = [(one, role) for comparisons in found.values() for one, role in _with_controls(comparisons)]
    called = {kind: labels([one for one, _ in everything], kind) for kind in ("attack", "defense", "victim")}
    keys = {id(one): key for key, (one, _) in enumerate(everything)}
    ranked = boards([one for comparisons in found.values() for one in comparisons if not one.is_baseline])
    said = [remark for comparisons in found.values() for remark in run_remarks(comparisons)]
    return {
        "out": None if folder is None else str(folder),
        "tracks": {own.name: describe_track(own) for own in found},
        "pairs": [pair(one, keys[id(one)], called, folder, role) for one, role in everything],
        "strongest": [_strongest(row, board, keys, called) for board in ranked for row in board.rows],
        "remarks": [{"name": one.name, "about": one.about, "text": one.text} for one in said],
    }


def _with_controls(comparisons: Sequence[Comparison]) -> list[tuple[Comparison, Role | None]]:
    """Each pair, then the clean controls, then each baseline once a world and type of action, with its role."""
    found: list[tuple[Comparison, Role | None]] = [
        (one, "baseline" if one.is_baseline else None) for one in comparisons
    ]
    found += [(one, "clean") for one in controls(comparisons)]
    seen = {one.own.table["unit"][0].as_py() for one, _ in found}
    for drive in (drive for one in comparisons for drive in one.baselines.values()):
        own = drive.only(runs=drive.runs[:1])
        if (unit := own.table["unit"][0].as_py()) not in seen:
            seen.add(unit)
            found.append((Comparison(identity_of(own), comparisons[0].track, own, own, {}), "baseline"))
    return found


def _strongest(row: Row, board: Board, keys: Mapping[int, int], called: Labels) -> dict[str, Any]:
    """A defended victim under the strongest attack of each cell."""
    worst, first = row.worst, row.attacks[0]
    cell, lowest = worst.worst_cell
    clean = worst.clean.estimate if worst.clean else 0.0
    return {
        "track": board.track.name,
        **named(first, ("defense", "victim"), called),
        "world": {"name": board.world[0], "params": parameters(board.world[1])},
        "grid": board.grid,
        "threat": threat(board.threat),
        "score": interval(worst.score),
        "failed": interval(worst.failure),
        "clean": interval(worst.clean),
        "kept": number(worst.score.estimate / clean) if clean > 0 else None,
        "worst_cell": dict(cell),
        "worst_cell_score": interval(lowest),
        "strongest": keys[id(first)],
        "pairs": [keys[id(attack)] for attack in row.attacks],
        "flags": [
            {"name": flag.name, "title": FLAGS[flag.name][0], "fired": flag.fired, "reason": flag.reason}
            for flag in row.flags
            if flag.fired
        ],
    }
