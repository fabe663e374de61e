"""`leaderboard.json`: the leaderboards for other tools, and what the page shows."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from bench.plugins.track import Track
from bench.scenarios import Axes, Cell
from bench.statistics.episodes import unit_interval
from bench.statistics.estimates import Array, Interval, task_intervals
from leaderboard.comparisons.alignment import Aligned, align
from leaderboard.comparisons.baselines import identity_of
from leaderboard.comparisons.comparison import THREAT, Comparison, parameters
from leaderboard.comparisons.naming import labels
from leaderboard.comparisons.reading import headline
from leaderboard.page.cards import card
from leaderboard.ranking.boards import Board, Row
from leaderboard.ranking.families import budgets, efforts
from leaderboard.ranking.flags import FLAGS

VERSION = 2
"""Of the schema; a reader that knows it can read every later document of the same version. Version 1 had the values of three
fixed axes in each cell."""
Labels = Mapping[str, Mapping[tuple[object, object], str]]
"""What a component is called: by its kind, then by its name and parameters."""


def schema() -> dict[str, Any]:
    """The JSON schema (draft 2020-12) of a document."""
    text = (files("leaderboard") / "data" / "leaderboard.schema.json").read_text(encoding="utf-8")
    return dict(json.loads(text))


def document(boards: Sequence[Board], comparisons: Sequence[Comparison], folder: Path | None) -> dict[str, Any]:
    """Everything that leaderboards say, as JSON values.

    Args:
        boards: the leaderboards.
        comparisons: all that was driven.
        folder: the results folder; None where records are published.
    """
    everything = [*comparisons, *_controls(comparisons)]
    called = {kind: labels(everything, kind) for kind in ("attack", "defense", "victim")}
    keys = {id(one): key for key, one in enumerate(everything)}
    tracks = {one.track.name: one.track for one in comparisons}
    return {
        "schema": VERSION,
        "cavbench": metadata.version("cavbench"),
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "tracks": {name: _track(track) for name, track in tracks.items()},
        "boards": [_board(board, keys, called) for board in boards],
        "pairs": [_pair(one, keys[id(one)], called, folder) for one in everything],
        "curves": [
            _curve(family, kind, aligned, keys) for kind, family in _families(comparisons) if (aligned := align(family))
        ],
    }


def _track(track: Track) -> dict[str, Any]:
    """What the numbers of a track mean."""
    contrast = track.contrast
    shown = {measure.column: measure for measure in track.measures}
    failure = shown.get(track.failure)
    return {
        "metric": track.metric,
        "title": track.metric_title,
        "legend": track.legend,
        "failure": track.failure,
        "failure_title": " ".join(failure.heading.split()) if failure else track.failure,
        "baseline": contrast.title if contrast and contrast.side == "victim" else "",
        "queries_title": track.queries_title,
        "artefact": track.artefact[0] if track.artefact else "",
    }


def _controls(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """Of every defended victim that was attacked, the same without an attack: the one that was driven most."""
    found: dict[tuple[object, ...], Comparison] = {}
    for one in comparisons:
        if one.is_attacked and one.clean:
            known = found.get(one.defended)
            if known is None or known.own.table.num_rows < one.clean.table.num_rows:
                control = Comparison(identity_of(one.clean), one.track, one.clean, one.clean, one.baselines)
                found[one.defended] = control
    return list(found.values())


def _families(comparisons: Sequence[Comparison]) -> list[tuple[str, list[Comparison]]]:
    """Attacks that were run with several budgets, and with several efforts."""
    attacks = [one for one in comparisons if one.is_attacked]
    return [
        *(("budget", family) for family in budgets(attacks)),
        *(("queries", family) for family in efforts(attacks)),
    ]


def _curve(family: Sequence[Comparison], kind: str, aligned: Aligned, keys: Mapping[int, int]) -> dict[str, Any]:
    """On the scenarios that all points have."""
    known = (one.clean for one in family if one.clean)
    control = next((one for one in known if set(aligned.cells) <= set(one.cells)), None)
    clean = family[0].score_of(control.only(cells=aligned.cells)) if control else None
    return {
        "kind": kind,
        "cells": len(aligned.cells),
        "clean": _interval(clean),
        "points": [
            {
                "x": one.queries if kind == "queries" else one.identity["threat_budget"],
                **(_interval(unit_interval(scores)) or {}),
                "pair": keys[id(one)],
            }
            for one, scores in zip(family, aligned.scores, strict=True)
        ],
    }


def _board(board: Board, keys: Mapping[int, int], called: Labels) -> dict[str, Any]:
    first = board.rows[0].attacks[0]
    cells = {cell for row in board.rows for cell in row.worst.cells}
    norm, budget, *_ = board.threat
    allowed = board.track.allowed(norm, budget, first.facts)
    return {
        "track": board.track.name,
        "world": {"name": board.world[0], "params": parameters(board.world[1])},
        "threat": {**_threat(board.threat), "allowed": allowed},
        "axes": _axes(first.axes, cells),
        "rows": [_row(row, keys, called) for row in board.rows],
        "baselines": [
            {
                "name": name,
                "score": _interval(first.score_of(drive)),
                "cells": _cells(drive.cells, drive.column(board.track.metric)),
            }
            for name, drive in board.baselines.items()
        ],
    }


def _axes(axes: Axes, cells: set[Cell]) -> list[dict[str, Any]]:
    """What the cells differ in, with the values that there are, in the order of tables."""
    return [
        {
            "name": axis.name,
            "meaning": axis.meaning,
            "unit": axis.unit,
            "perceptual": axis.perceptual,
            "values": sorted({cell[axis.name] for cell in cells}, key=axis.place),
        }
        for axis in axes.values()
    ]


def _threat(values: Sequence[object]) -> dict[str, object]:
    return {name.removeprefix("threat_"): value for name, value in zip(THREAT, values, strict=True)}


def _row(row: Row, keys: Mapping[int, int], called: Labels) -> dict[str, Any]:
    worst = row.worst
    cells = _cells(worst.cells, worst.scores)
    for cell, attack, rival in zip(cells, worst.attacks, worst.rival, strict=True):
        cell |= {"pair": keys[id(attack)], "baseline": _number(float(rival.mean()))}
    first = row.attacks[0]
    return {
        "group": row.group,
        "flagged": row.flagged,
        **_named(first, ("defense", "victim"), called),
        "score": _interval(worst.score),
        "clean": _interval(row.clean),
        "lead": _interval(worst.lead),
        "strongest": keys[id(first)],
        "pairs": [keys[id(attack)] for attack in row.attacks],
        "training_seeds": list(worst.runs),
        "scenarios": worst.scores.shape[2],
        "cells": cells,
        "flags": [
            {"name": flag.name, "title": FLAGS[flag.name][0], "fired": flag.fired, "reason": flag.reason}
            for flag in row.flags
        ],
    }


def _named(one: Comparison, kinds: Sequence[str], called: Labels) -> dict[str, Any]:
    return {
        kind: {
            "name": one.identity[kind],
            "label": called[kind][one.identity[kind], one.identity[f"{kind}_params"]],
            "params": parameters(one.identity[f"{kind}_params"]),
        }
        for kind in kinds
    }


def _pair(one: Comparison, key: int, called: Labels, folder: Path | None) -> dict[str, Any]:
    own, identity = one.own, one.identity
    cells = _cells(own.cells, one.scores)
    for name, column in (("failed", one.track.failure), ("queries", one.track.queries)):
        if column in own.table.column_names:
            for cell, value in zip(cells, own.column(column).mean((0, 2)).tolist(), strict=True):
                cell[name] = _number(value)
    return {
        "key": key,
        "track": one.track.name,
        **_named(one, ("attack", "defense", "victim"), called),
        "world": {"name": identity["world"], "params": parameters(identity["world_params"])},
        "threat": _threat([identity[name] for name in THREAT]),
        "asks": one.knowledge if one.is_attacked else "nothing",
        "score": _interval(one.score),
        "clean": _interval(one.clean_score),
        "queries": _number(one.queries),
        "measures": {measure.column: _interval(one.measured(measure)) for measure in headline(one.track)},
        "cells": cells,
        "card": card(one, folder),
    }


def _cells(cells: Sequence[Cell], scores: Array) -> list[dict[str, Any]]:
    """Each cell's estimate and interval, and the mean of each run there, so that a reader can average over some of them."""
    means = scores.mean(2)
    errors = scores[0].std(1) / np.sqrt(scores.shape[2])
    return [
        {
            "cell": dict(cell),
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
