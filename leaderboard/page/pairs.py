"""Attacks on defended victims, and their controls, as JSON values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cavbench.core.track import Track
from cavbench.leaderboard.comparisons.baselines import identity_of
from cavbench.leaderboard.comparisons.comparison import THREAT, Comparison, parameters
from cavbench.leaderboard.comparisons.reading import headline
from cavbench.leaderboard.page.cards import card
from cavbench.leaderboard.ranking.columns import Value
from cavbench.leaderboard.ranking.remarks import comparison_remarks
from cavbench.scenarios import Cell
from cavbench.statistics.doubts import Remark
from cavbench.statistics.episodes import measured
from cavbench.statistics.estimates import Array, Interval, share_interval, task_intervals

Labels = Mapping[str, Mapping[tuple[object, object], str]]
"""What a component is called: by its kind, then by its name and parameters."""
Role = Literal["attacked", "clean", "baseline"]


def describe_track(track: Track) -> dict[str, Any]:
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


def controls(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """Of every defended victim that was attacked, the same without an attack: the one that was driven most."""
    found: dict[tuple[object, ...], Comparison] = {}
    for one in comparisons:
        if one.is_attacked and one.clean:
            known = found.get(one.ranked_as)
            if known is None or known.own.table.num_rows < one.clean.table.num_rows:
                identity = identity_of(one.clean)
                found[one.ranked_as] = Comparison(
                    identity, one.track, one.clean, one.clean, one.baselines, mine=one.mine
                )
    return list(found.values())


def pair(one: Comparison, key: int, called: Labels, folder: Path | None, role: Role | None = None) -> dict[str, Any]:
    """What was measured of a pair, in all cells together and in each, and its card.

    Args:
        one: the pair.
        key: by which the document refers to it.
        called: what its components are called.
        folder: the results folder; None where records are published.
        role: by default whether there is an attack.
    """
    own, identity, track = one.own, one.identity, one.track
    scored = cells(own.cells, one.scores)
    for name, column in (("failed", track.failure), ("queries", track.queries)):
        if column in own.table.column_names:
            for cell, value in zip(scored["cells"], own.column(column).mean((0, 2)).tolist(), strict=True):
                cell[name] = number(value)
    failed = next((measure for measure in track.measures if measure.column == track.failure), None)
    return {
        "key": key,
        "mine": one.mine,
        "role": role or ("attacked" if one.is_attacked else "clean"),
        "track": track.name,
        **(named(one, ("attack", "defense", "victim"), called) | _mixture(one)),
        "world": {"name": identity["world"], "params": parameters(identity["world_params"])},
        "grid": identity["grid"],
        "threat": threat([identity[name] for name in THREAT]),
        "asks": one.knowledge if one.is_attacked else "nothing",
        "score": interval(one.score),
        "clean": interval(one.clean_score),
        "kept": number(one.retained),
        "failed": interval(measured(own, failed)) if failed else None,
        "lead": interval(one.lead),
        "queries": number(one.queries),
        "measures": {measure.column: interval(one.measured(measure)) for measure in headline(track)},
        **scored,
        "remarks": remarks(comparison_remarks(one)),
        "card": card(one, folder),
    }


def named(one: Comparison, kinds: Sequence[str], called: Labels) -> dict[str, Any]:
    """Components of a pair, with what they are called and their parameters."""
    return {
        kind: {
            "name": one.identity[kind],
            "label": called[kind][one.identity[kind], one.identity[f"{kind}_params"]],
            "params": parameters(one.identity[f"{kind}_params"]),
        }
        for kind in kinds
    }


def _mixture(one: Comparison) -> dict[str, Any]:
    """The victim of a baseline that is another policy in each cell: its title, and all values of what differs; else nothing."""
    every = [parameters(text) for text in sorted(one.own.table["victim_params"].unique().to_pylist())]
    if len(every) < 2:
        return {}
    title = one.track.baseline_kinds[one.track.baseline_of(one.identity, one.identity)].title
    values = {name: list({str(params.get(name)): params.get(name) for params in every}.values()) for name in every[0]}
    params = {name: several if len(several) > 1 else several[0] for name, several in values.items()}
    return {"victim": {"name": one.identity["victim"], "label": title, "params": params}}


def threat(values: Sequence[object]) -> dict[str, object]:
    """A threat model, from the values of `THREAT`."""
    return {name.removeprefix("threat_"): value for name, value in zip(THREAT, values, strict=True)}


def remarks(found: Sequence[Remark]) -> list[dict[str, str]]:
    """Remarks on a pair or a row."""
    return [{"name": one.name, "text": one.text} for one in found]


def cells(names: Sequence[Cell], scores: Array) -> dict[str, Any]:
    """Each cell's estimate and interval, and those of all cells that share a value of an axis.

    Args:
        names: the cells [C].
        scores: [R, C, E].
    """
    means = scores.mean(2)
    return {
        "cells": [
            {
                "cell": dict(cell),
                **(interval(found) or {}),
                "runs": [number(value) for value in means[:, place].tolist()],
            }
            for place, (cell, found) in enumerate(zip(names, task_intervals(scores, share=True), strict=True))
        ],
        "scenarios": scores.shape[2],
        "parts": [
            {"axis": name, "value": value, **(interval(share_interval(scores[:, places])) or {})}
            for name in (names[0] if names else ())
            for value in dict.fromkeys(cell[name] for cell in names)
            if 1 < len(places := [n for n, cell in enumerate(names) if cell[name] == value]) < len(names)
        ],
    }


def interval(found: Interval | None) -> dict[str, Any] | None:
    """An interval; None where there is none."""
    if found is None:
        return None
    return {"estimate": number(found.estimate), "low": number(found.low), "high": number(found.high)}


def value(found: Value) -> object:
    """What a row has in a column."""
    if isinstance(found, Interval):
        return interval(found) if np.isfinite(found.estimate) else None
    return number(found) if isinstance(found, float) else found


def number(found: float) -> float | None:
    """Four digits behind the point; None where there is no number."""
    return round(found, 4) if math.isfinite(found) else None
