"""`leaderboard.json`: the leaderboards for other tools, and what the page shows."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from cavbench.core.track import Track
from cavbench.leaderboard.comparisons.alignment import Aligned, align
from cavbench.leaderboard.comparisons.baselines import identity_of
from cavbench.leaderboard.comparisons.comparison import THREAT, Comparison, parameters
from cavbench.leaderboard.comparisons.naming import labels
from cavbench.leaderboard.comparisons.reading import headline
from cavbench.leaderboard.page.cards import card
from cavbench.leaderboard.ranking.boards import Board, Row
from cavbench.leaderboard.ranking.columns import Column, Value, columns
from cavbench.leaderboard.ranking.curves import Curve
from cavbench.leaderboard.ranking.families import budgets, efforts
from cavbench.leaderboard.ranking.flags import FLAGS
from cavbench.leaderboard.ranking.remarks import comparison_remarks
from cavbench.scenarios import Axes, Cell
from cavbench.statistics.doubts import Remark
from cavbench.statistics.estimates import Array, Interval, share_interval, task_intervals

VERSION = 1
"""Of the schema; a reader that knows it can read every later document of the same version."""
Labels = Mapping[str, Mapping[tuple[object, object], str]]
"""What a component is called: by its kind, then by its name and parameters."""


def schema() -> dict[str, Any]:
    """The JSON schema (draft 2020-12) of a document."""
    text = (files("cavbench.leaderboard") / "data" / "leaderboard.schema.json").read_text(encoding="utf-8")
    return dict(json.loads(text))


def document(
    boards: Sequence[Board], comparisons: Sequence[Comparison], folder: Path | None, link: str = ""
) -> dict[str, Any]:
    """Everything that leaderboards say, as JSON values.

    Args:
        boards: the leaderboards.
        comparisons: all that was driven.
        folder: the results folder; None where records are published.
        link: the beginning of a link from the page to the results folder.
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
        "boards": [_board(board, keys, called, folder, link) for board in boards],
        "pairs": [_pair(one, keys[id(one)], called, folder) for one in everything],
        "curves": [
            _curve(found, kind, aligned, keys)
            for kind, family in _families(comparisons)
            if (aligned := align(family)) and (found := Curve.of(family, aligned))
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


def _curve(curve: Curve, kind: str, aligned: Aligned, keys: Mapping[int, int]) -> dict[str, Any]:
    """On the scenarios that all points have, in the cells that are not at the floor or the ceiling."""
    known = (one.clean for one in curve.points if one.clean)
    control = next((one for one in known if set(curve.cells) <= set(one.cells)), None)
    clean = curve.points[0].score_of(control.only(cells=curve.cells)) if control else None
    return {
        "kind": kind,
        "cells": [dict(cell) for cell in curve.cells],
        "left_out": curve.left_out,
        "clean": _interval(clean),
        "points": [
            {
                "x": one.queries if kind == "queries" else one.identity["threat_budget"],
                **(_interval(score) or {}),
                "pair": keys[id(one)],
            }
            for one, score in zip(curve.points, curve.scores, strict=True)
        ],
    }


def clip(row: Row, board: Board, folder: Path | None, link: str) -> str | None:
    """The film of a row, as a link from the page: `clips/NORM-BUDGET-DEFENCE+VICTIM.webp` in the results folder; None for none.

    Published records have theirs beside the published page.
    """
    norm, budget, *_ = board.threat
    name = f"clips/{norm}-{budget:g}-{row.identity['defense']}+{row.identity['victim']}.webp"
    home = folder or Path(str(files("cavbench.leaderboard")))
    first = board.rows.index(next(one for one in board.rows if _plain_name(one) == _plain_name(row)))
    return link + quote(name, safe="/+") if (home / name).is_file() and board.rows[first] is row else None


def _plain_name(row: Row) -> tuple[object, object]:
    return row.identity["defense"], row.identity["victim"]


def _board(board: Board, keys: Mapping[int, int], called: Labels, folder: Path | None, link: str) -> dict[str, Any]:
    first = board.rows[0].attacks[0]
    cells = {cell for row in board.rows for cell in row.worst.cells}
    norm, budget, *_ = board.threat
    allowed = board.track.allowed(norm, budget, first.facts)
    return {
        "track": board.track.name,
        "world": {"name": board.world[0], "params": parameters(board.world[1])},
        "grid": board.grid,
        "threat": {**_threat(board.threat), "allowed": allowed},
        "axes": _axes(first.axes, cells),
        "columns": [_column(one) for one in columns(board)],
        "rows": [{**_row(row, board, keys, called), "clip": clip(row, board, folder, link)} for row in board.rows],
        "baselines": [
            {
                "name": name,
                "score": _interval(first.score_of(drive)),
                **_cells(drive.cells, drive.column(board.track.metric)),
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


def _column(one: Column) -> dict[str, Any]:
    """What a column of the rows is; its values are in `values` of a row, and in those of its cells if it has some there."""
    said = {name: getattr(one, name) for name in ("name", "title", "meaning", "kind", "digits", "interval", "shown")}
    return {**said, "by_cell": one.by_cell is not None}


def _row(row: Row, board: Board, keys: Mapping[int, int], called: Labels) -> dict[str, Any]:
    worst, first = row.worst, row.attacks[0]
    listed = columns(board)
    scored = _cells(worst.cells, worst.scores)
    by_cell = {one.name: one.by_cell(worst).tolist() for one in listed if one.by_cell}
    for place, (cell, attack, rival) in enumerate(zip(scored["cells"], worst.attacks, worst.rival, strict=True)):
        cell |= {"pair": keys[id(attack)], "baseline": _number(float(rival.mean()))}
        cell["values"] = {name: _number(values[place]) for name, values in by_cell.items()}

    def label(one: Comparison, kind: str) -> str:
        return called[kind][one.identity[kind], one.identity[f"{kind}_params"]]

    return {
        "flagged": row.flagged,
        **_named(first, ("defense", "victim"), called),
        "values": {one.name: _value(one.value(row, label)) for one in listed},
        "strongest": keys[id(first)],
        "pairs": [keys[id(attack)] for attack in row.attacks],
        "marginal": [_interval(row.marginal.get(attack)) for attack in row.attacks],
        "left_out": [keys[id(attack)] for attack in row.left_out],
        "training_seeds": list(worst.runs),
        **scored,
        "flags": [
            {"name": flag.name, "title": FLAGS[flag.name][0], "fired": flag.fired, "reason": flag.reason}
            for flag in row.flags
        ],
        "remarks": _remarks(row.remarks),
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
    scored = _cells(own.cells, one.scores)
    for name, column in (("failed", one.track.failure), ("queries", one.track.queries)):
        if column in own.table.column_names:
            for cell, value in zip(scored["cells"], own.column(column).mean((0, 2)).tolist(), strict=True):
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
        **scored,
        "remarks": _remarks(comparison_remarks(one)),
        "card": card(one, folder),
    }


def _remarks(found: Sequence[Remark]) -> list[dict[str, str]]:
    return [{"name": one.name, "text": one.text} for one in found]


def _cells(cells: Sequence[Cell], scores: Array) -> dict[str, Any]:
    """Each cell's estimate and interval, and those of all cells that share a value of an axis."""
    means = scores.mean(2)
    return {
        "cells": [
            {
                "cell": dict(cell),
                **(_interval(found) or {}),
                "runs": [_number(value) for value in means[:, place].tolist()],
            }
            for place, (cell, found) in enumerate(zip(cells, task_intervals(scores, share=True), strict=True))
        ],
        "scenarios": scores.shape[2],
        "parts": [
            {"axis": name, "value": value, **(_interval(share_interval(scores[:, places])) or {})}
            for name in (cells[0] if cells else ())
            for value in dict.fromkeys(cell[name] for cell in cells)
            if 1 < len(places := [n for n, cell in enumerate(cells) if cell[name] == value]) < len(cells)
        ],
    }


def _interval(found: Interval | None) -> dict[str, Any] | None:
    if found is None:
        return None
    return {"estimate": _number(found.estimate), "low": _number(found.low), "high": _number(found.high)}


def _value(found: Value) -> object:
    """What a row has in a column, as JSON."""
    if isinstance(found, Interval):
        return _interval(found) if np.isfinite(found.estimate) else None
    return _number(found) if isinstance(found, float) else found


def _number(value: float) -> float | None:
    """Four digits behind the point; null where there is no number."""
    return round(value, 4) if np.isfinite(value) else None
