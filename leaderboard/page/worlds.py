"""The leaderboards over worlds as JSON values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cavbench.leaderboard.page.pairs import interval, number, threat
from cavbench.leaderboard.ranking.worlds import InWorld, WorldBoard, WorldRow
from cavbench.leaderboard.terminal.worlds import notes, title


def world_boards(boards: Sequence[WorldBoard]) -> list[dict[str, Any]]:
    """Each leaderboard over worlds: its worlds, its rows from the best down, and what a reader must know."""
    return [
        {
            "track": board.track.name,
            "threat": threat(board.threat),
            "worlds": [
                {"name": name, "grid": grid, "counts": name not in board.without_scale}
                for name, grid in board.grids.items()
            ],
            "rows": [_row(row) for row in board.rows],
            "notes": notes(board),
        }
        for board in boards
    ]


def _row(row: WorldRow) -> dict[str, Any]:
    method = row.method
    return {
        "rank": row.group or None,
        "name": title(method),
        "defense": method.defense,
        "victim": method.victim,
        "trained_in": method.home or None,
        "mine": method.mine,
        "mean": interval(row.mean),
        "worst_world": None if row.worst is None else {"name": row.worst[0], "share": number(row.worst[1])},
        "lacks": dict(row.lacks),
        "attacks": list(row.attacks),
        "worlds": {name: _place(place) for name, place in row.places.items()},
    }


def _place(place: InWorld) -> dict[str, Any]:
    """A row in a world: its share of the scale, the score that this is of, and the scores of the scale's ends."""
    worst = place.worst
    ends = {
        name: None if value is None else number(value)
        for name, value in (("share", place.share), ("blind", place.blind), ("perfect", place.perfect))
    }
    return {
        **ends,
        "score": interval(worst.score),
        "training_seeds": list(worst.runs),
        "cells": worst.shape[0],
        "scenarios": worst.shape[1],
    }
