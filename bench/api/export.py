"""Scores as a table for LaTeX, and as plots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import pandas as pd

from cavbench.core import registry
from cavbench.errors import UserError
from cavbench.latex import booktabs, escaped, estimate
from cavbench.scenarios.axes import written

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Plot = Literal["matrix", "cells", "budget"]
NAMES = ("role", "victim", "defense", "attack")
COLOURS = "cividis"
"""Safe for colour-blind eyes."""


def metric(scores: pd.DataFrame) -> str:
    """The column of the ranking metric, which stands before its interval."""
    return str(scores.columns[list(scores.columns).index("low") - 1])


def failure(scores: pd.DataFrame) -> str:
    """The column of the track's failure; empty where it has none."""
    return next((str(name).removesuffix("_low") for name in scores.columns if str(name).endswith("_low")), "")


def latex(scores: pd.DataFrame) -> str:
    """The main columns, scores and failure rates with their intervals."""
    names = [name for name in scores.columns if name in NAMES or name in _axes(scores)]
    numbers = [name for name in (metric(scores), failure(scores)) if name]
    lines = []
    for _, row in scores.iterrows():
        ends = [
            (row["low"], row["high"]),
            *([(row[f"{failure(scores)}_low"], row[f"{failure(scores)}_high"])] * (len(numbers) > 1)),
        ]
        kept = "" if pd.isna(row["kept"]) else f"{row['kept']:.2f}"
        texts = [escaped(str(row[name])) for name in names]
        lines.append([*texts, *(estimate(row[name], *end) for name, end in zip(numbers, ends, strict=True)), kept])
    heads = [escaped(name.replace("_", " ").capitalize()) for name in (*names, *numbers, "kept")]
    return booktabs("mean and 95 % interval", "l" * len(names) + "r" * (len(numbers) + 1), heads, lines)


def _axes(scores: pd.DataFrame) -> list[str]:
    """The columns of the axes of the world, which stand between the names and the metric; empty unless scores are by cell."""
    columns = list(map(str, scores.columns))
    return columns[columns.index("victim") + 1 : columns.index(metric(scores))]


def plot(scores: Any, kind: Plot, others: Sequence[Any], axes: Axes | None) -> Axes:
    """A plot of scores (`cavbench.api.table.Scores.plot`)."""
    if kind not in get_args(Plot):
        raise UserError(registry.unknown(f"plot {kind!r}", kind, list(get_args(Plot))))
    if others and kind != "budget":
        raise UserError(f"plot({kind!r}) shows one table of scores; only 'budget' takes others")
    try:
        from matplotlib import pyplot
    except ImportError:
        raise UserError("scores.plot() needs matplotlib: pip install 'cavbench[plot]'") from None
    axes = axes or pyplot.figure(layout="constrained").add_subplot()
    drawn = {"matrix": _matrix, "cells": _cells, "budget": _budget}[kind]
    drawn([scores, *others], axes)
    return axes


def _matrix(tables: Sequence[pd.DataFrame], axes: Axes) -> None:
    """Attack by defence: clean scores first, then the strongest attack, then the others."""
    (scores,) = tables
    own = scores[scores["role"] != "baseline"]
    if _axes(scores):
        raise UserError("plot('matrix') is for scores by pair: leave out by='cell'")
    rows = own["defense"].where(own["defense"] != "none", "no defence") + " · " + own["victim"]
    columns = own["attack"].where(own["role"] != "clean", "no attack")
    values = dict(zip(zip(rows, columns, strict=True), own[metric(scores)], strict=True))
    _heat(
        axes,
        list(dict.fromkeys(rows)),
        ["no attack", *dict.fromkeys(columns[own["role"] != "clean"])],
        values,
        metric(scores),
    )


def _cells(tables: Sequence[pd.DataFrame], axes: Axes) -> None:
    """The cells of the strongest attack on the first victim; of one attack, that; without an attack, clean scores."""
    (scores,) = tables
    names = _axes(scores)
    if not names:
        raise UserError("plot('cells') is for scores by cell: score(..., by='cell')")
    role = next(role for role in ("strongest", "attacked", "clean", "baseline") if (scores["role"] == role).any())
    own = scores[scores["role"] == role]
    own = own[(own[list(NAMES)] == own[list(NAMES)].iloc[0]).all(axis=1)]
    texts = own[names].map(written)
    down = texts[names[:-1]].agg(" × ".join, axis=1) if len(names) > 1 else pd.Series("", own.index)
    across = texts[names[-1]]
    values = dict(zip(zip(down, across, strict=True), own[metric(scores)], strict=True))
    _heat(axes, list(dict.fromkeys(down)), list(dict.fromkeys(across)), values, metric(scores))
    axes.set_ylabel(" × ".join(names[:-1]))
    axes.set_xlabel(names[-1])
    first = own.iloc[0]
    axes.set_title(f"{first['attack']} on {first['victim']}, defence {first['defense']}")


def _heat(axes: Axes, rows: list[str], columns: list[str], values: dict[Any, float], name: str) -> None:
    grid = np.array([[values.get((row, column), np.nan) for column in columns] for row in rows], float)
    image = axes.imshow(grid, cmap=COLOURS, vmin=0, vmax=1, aspect="auto")
    axes.set_xticks(range(len(columns)), columns, rotation=30, ha="right")
    axes.set_yticks(range(len(rows)), rows)
    for (row, column), value in np.ndenumerate(grid):
        if not np.isnan(value):
            axes.text(column, row, f"{value:.2f}", ha="center", va="center", color="black" if value > 0.5 else "white")
    axes.figure.colorbar(image, ax=axes, label=name.replace("_", " "))


def _budget(tables: Sequence[Any], axes: Axes) -> None:
    """A line for each attack on each defended victim, from the clean score at 0 on."""
    found: dict[str, list[tuple[float, float, float, float]]] = {}
    for scores in tables:
        if _axes(scores):
            raise UserError("plot('budget') is for scores by pair: leave out by='cell'")
        name = metric(scores)
        budgets = scores.records.groupby("pair")["threat_budget"].first()
        clean = {(row.victim, row.defense): row for row in scores[scores["role"] == "clean"].itertuples()}
        for row in scores[scores["role"] == "attacked"].itertuples():
            line = found.setdefault(f"{row.attack} on {row.victim}" + f" + {row.defense}" * (row.defense != "none"), [])
            for budget, one in ((0.0, clean[row.victim, row.defense]), (float(budgets[row.pair]), row)):
                line.append((budget, getattr(one, name), one.low, one.high))
    if not found:
        raise UserError("plot('budget') needs an attack")
    for label, points in found.items():
        budgets, values, low, high = np.array(sorted(dict.fromkeys(points))).T
        # Without an interval, as of one scenario, there is no bar.
        bars = np.nan_to_num(np.abs(np.stack([values - low, high - values])))
        axes.errorbar(budgets, values, yerr=bars, marker="o", capsize=2, label=label)
    axes.set_ylim(0, 1)
    axes.set_xlabel("budget; 0 is no attack")
    axes.set_ylabel(metric(tables[0]).replace("_", " "))
    axes.legend()
