"""`leaderboard.json`: the leaderboards for other tools, and what the page shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

from cavbench.leaderboard.comparisons.alignment import Aligned, align
from cavbench.leaderboard.comparisons.comparison import Comparison, parameters
from cavbench.leaderboard.comparisons.naming import labels
from cavbench.leaderboard.page.pairs import (
    Labels,
    cells,
    controls,
    describe_track,
    interval,
    named,
    number,
    pair,
    remarks,
    threat,
    value,
)
from cavbench.leaderboard.page.worlds import world_boards
from cavbench.leaderboard.ranking.attackers import Attacker, attackers
from cavbench.leaderboard.ranking.boards import Board, Row
from cavbench.leaderboard.ranking.columns import Column, columns
from cavbench.leaderboard.ranking.curves import Curve
from cavbench.leaderboard.ranking.families import budgets, efforts
from cavbench.leaderboard.ranking.flags import FLAGS
from cavbench.leaderboard.ranking.worlds import WorldBoard
from cavbench.scenarios import Axes, Cell


def document(
    boards: Sequence[Board],
    comparisons: Sequence[Comparison],
    folder: Path | None,
    link: str = "",
    *,
    worlds: Sequence[WorldBoard] = (),
) -> dict[str, Any]:
    """Everything that leaderboards say, as the content of a document (`cavbench.documents`).

    Args:
        boards: the leaderboards.
        comparisons: all that was driven.
        folder: the results folder; None where records are published.
        link: the beginning of a link from the page to the results folder.
        worlds: the leaderboards over worlds.
    """
    everything = [*comparisons, *controls(comparisons)]
    called = {kind: labels(everything, kind) for kind in ("attack", "defense", "victim")}
    keys = {id(one): key for key, one in enumerate(everything)}
    tracks = {one.track.name: one.track for one in comparisons}
    return {
        "tracks": {name: describe_track(track) for name, track in tracks.items()},
        "boards": [_board(board, keys, called, folder, link) for board in boards],
        "worlds": world_boards(worlds),
        "pairs": [pair(one, keys[id(one)], called, folder) for one in everything],
        "curves": [
            _curve(found, kind, aligned, keys)
            for kind, family in _families(comparisons)
            if (aligned := align(family)) and (found := Curve.of(family, aligned))
        ],
    }


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
        "clean": interval(clean),
        "points": [
            {
                "x": one.queries if kind == "queries" else one.identity["threat_budget"],
                **(interval(score) or {}),
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
    driven = {cell for row in board.rows for cell in row.worst.cells}
    norm, budget, *_ = board.threat
    allowed = board.track.allowed(norm, budget, first.facts)
    return {
        "track": board.track.name,
        "world": {"name": board.world[0], "params": parameters(board.world[1])},
        "grid": board.grid,
        "threat": {**threat(board.threat), "allowed": allowed},
        "axes": _axes(first.axes, driven),
        "columns": [_column(one) for one in columns(board)],
        "rows": [{**_row(row, board, keys, called), "clip": clip(row, board, folder, link)} for row in board.rows],
        "attackers": [_attacker(one, keys) for one in attackers(board)],
        "baselines": [
            {
                "name": name,
                "score": interval(first.score_of(drive)),
                **cells(drive.cells, drive.column(board.track.metric)),
            }
            for name, drive in board.baselines.items()
        ],
    }


def _attacker(one: Attacker, keys: Mapping[int, int]) -> dict[str, Any]:
    measured = {name: number(getattr(one, name)) for name in ("added", "alone", "strongest", "queries", "seconds")}
    counts = {"rank": one.group, "name": one.name, "rows": one.rows, "variants": one.variants}
    return {**counts, **measured, "pairs": [keys[id(attack)] for attack in one.attacks]}


def _axes(axes: Axes, driven: set[Cell]) -> list[dict[str, Any]]:
    """What the cells differ in, with the values that there are, in the order of tables."""
    return [
        {
            "name": axis.name,
            "meaning": axis.meaning,
            "unit": axis.unit,
            "perceptual": axis.perceptual,
            "values": sorted({cell[axis.name] for cell in driven}, key=axis.place),
        }
        for axis in axes.values()
    ]


def _column(one: Column) -> dict[str, Any]:
    """What a column of the rows is; its values are in `values` of a row, and in those of its cells if it has some there."""
    said = {name: getattr(one, name) for name in ("name", "title", "meaning", "kind", "digits", "interval", "shown")}
    return {**said, "by_cell": one.by_cell is not None}


def _row(row: Row, board: Board, keys: Mapping[int, int], called: Labels) -> dict[str, Any]:
    worst, first = row.worst, row.attacks[0]
    listed = columns(board)
    scored = cells(worst.cells, worst.scores)
    by_cell = {one.name: one.by_cell(worst).tolist() for one in listed if one.by_cell}
    for place, (cell, attack, rival) in enumerate(zip(scored["cells"], worst.attacks, worst.rival, strict=True)):
        cell |= {"pair": keys[id(attack)], "baseline": number(float(rival.mean()))}
        cell["values"] = {name: number(values[place]) for name, values in by_cell.items()}

    def label(one: Comparison, kind: str) -> str:
        return called[kind][one.identity[kind], one.identity[f"{kind}_params"]]

    return {
        "flagged": row.flagged,
        "mine": row.mine,
        **named(first, ("defense", "victim"), called),
        "values": {one.name: value(one.value(row, label)) for one in listed},
        "strongest": keys[id(first)],
        "pairs": [keys[id(attack)] for attack in row.attacks],
        "marginal": [interval(row.marginal.get(attack)) for attack in row.attacks],
        "left_out": [keys[id(attack)] for attack in row.left_out],
        "training_seeds": list(worst.runs),
        **scored,
        "flags": [
            {"name": flag.name, "title": FLAGS[flag.name][0], "fired": flag.fired, "reason": flag.reason}
            for flag in row.flags
        ],
        "remarks": remarks(row.remarks),
    }
