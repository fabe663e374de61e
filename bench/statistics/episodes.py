"""Arranges the episodes of a pair and computes estimates with intervals, for one cell or a whole grid.

Records come as a `pyarrow.Table`, one row per episode (columns: `cavbench.records.schema`). `Episodes.arrange` sorts the rows of
one pair by training seed, cell and scenario seed; `measured` aggregates them; `difference` compares two sets by scenario.
The statistics are in `cavbench.statistics.estimates`.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cavbench.core.track import Measure
from cavbench.scenarios import Axes, Cell
from cavbench.statistics.estimates import Array, Interval, interval, share_interval


@dataclass(frozen=True)
class Episodes:
    """The episodes of one pair: every run has every cell, and every cell every scenario seed.

    Args:
        table: the records, sorted by run, cell, scenario seed; [R * C * E] rows.
        runs: training seeds [R].
        cells: [C], in the order of tables (`Axes.place`).
        axes: axes of the cells.
        seeds: scenario seeds [E], ascending.
        left_out: number of records that `arrange` dropped because another run or cell lacks their scenario.
    """

    table: pa.Table
    runs: tuple[int, ...]
    cells: tuple[Cell, ...]
    seeds: tuple[int, ...]
    axes: Axes
    left_out: int = 0

    @classmethod
    def arrange(cls, records: pa.Table) -> Episodes:
        """Sort the records of one pair, and keep the largest part in which every run has every cell with every seed.

        So a few stray records of another run, cell or seed do not change what is kept.

        Raises:
            ValueError: if there are no records, or a scenario occurs twice.
        """
        if not records.num_rows:
            raise ValueError("no records to measure")
        runs, run = _distinct(records["training_seed"])
        seeds, seed = _distinct(records["seed"])
        axes = axes_of(records)
        cells, cell = _cells(records, axes)
        place = np.full((len(runs), len(cells), len(seeds)), -1)
        place[run, cell, seed] = np.arange(records.num_rows)
        driven = place >= 0
        if driven.sum() < records.num_rows:
            raise ValueError("a scenario occurs twice: these are records of more than one pair")
        of_runs, of_cells, of_seeds = _largest(driven)
        rows = place[np.ix_(of_runs, of_cells, of_seeds)].ravel()
        whole = len(rows) == records.num_rows and bool((rows[1:] > rows[:-1]).all())
        return Episodes(
            table=records if whole else records.take(pa.array(rows)),
            runs=tuple(runs[i] for i in of_runs),
            cells=tuple(cells[i] for i in of_cells),
            seeds=tuple(seeds[i] for i in of_seeds),
            axes=axes,
            left_out=records.num_rows - len(rows),
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """(R, C, E): runs, cells, episodes per run and cell."""
        return len(self.runs), len(self.cells), len(self.seeds)

    def column(self, name: str) -> Array:
        """A measurement [R, C, E] as float64."""
        values = self.table[name].to_numpy(zero_copy_only=False)
        return np.asarray(values, dtype=np.float64).reshape(self.shape)

    def places(
        self, runs: Sequence[int], cells: Sequence[Cell], seeds: Sequence[int]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """An index into arrays [R, C, E] of these episodes that takes out the given runs, cells and seeds, in that order.

        The single run of a victim that does not learn stands for every run that it lacks.
        """
        alone = len(self.runs) == 1 and set(runs) != set(self.runs)
        of_runs = [0 if alone else self.runs.index(run) for run in runs]
        of_cells, of_seeds = [self.cells.index(cell) for cell in cells], [self.seeds.index(seed) for seed in seeds]
        return np.ix_(of_runs, of_cells, of_seeds)  # type: ignore[return-value]

    def only(
        self,
        *,
        runs: Collection[int] | None = None,
        cells: Collection[Cell] | None = None,
        seeds: Collection[int] | None = None,
    ) -> Episodes:
        """The episodes of these runs, cells and scenario seeds; None keeps all.

        Raises:
            ValueError: if nothing is left.
        """
        axes = (_places(self.runs, runs), _places(self.cells, cells), _places(self.seeds, seeds))
        if not all(axes):
            raise ValueError("no episode is left")
        if tuple(map(len, axes)) == self.shape:
            return self
        rows = np.arange(self.table.num_rows).reshape(self.shape)[np.ix_(*axes)].ravel()
        return Episodes(
            table=self.table.take(pa.array(rows)),
            runs=tuple(self.runs[i] for i in axes[0]),
            cells=tuple(self.cells[i] for i in axes[1]),
            seeds=tuple(self.seeds[i] for i in axes[2]),
            axes=self.axes,
            left_out=self.left_out,
        )

    def standing_for(self, runs: Sequence[int], cells: Sequence[Cell]) -> Episodes:
        """Relabel the episodes of an input-independent victim that does not learn with other runs and cells.

        Args:
            runs: training seeds; each gets the episodes of the first run.
            cells: each must have been driven, either itself or with its perceptual axes at their first value.

        Raises:
            ValueError: if a cell was driven in neither form.
        """
        stand_ins = [cell if cell in self.cells else self.axes.unperceived(cell) for cell in cells]
        missing = [str(cell) for cell, stand_in in zip(cells, stand_ins, strict=True) if stand_in not in self.cells]
        if missing:
            raise ValueError(f"never driven: {'; '.join(missing)}")
        count = len(self.seeds)
        first_run = np.arange(self.table.num_rows).reshape(self.shape)[0]
        rows = np.concatenate([first_run[self.cells.index(stand_in)] for stand_in in stand_ins])
        table = self.table.take(pa.array(np.tile(rows, len(runs))))
        labels = {
            "training_seed": np.repeat(runs, len(cells) * count),
            "cell": np.tile(np.repeat([as_text(cell) for cell in cells], count), len(runs)),
        }
        for name, values in labels.items():
            field = table.schema.field(name)
            table = table.set_column(table.schema.get_field_index(name), field, pa.array(values.tolist(), field.type))
        return Episodes.arrange(table)


def _largest(driven: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The indices of the runs, cells and seeds of the largest complete part of `driven` [R, C, E].

    Looked for among the parts that one cell of one run begins: its seeds, with all cells of that run that have them, with all
    runs that have these. Of equally large parts the one with more runs counts.
    """
    if driven.all():
        return tuple(np.arange(count) for count in driven.shape)  # type: ignore[return-value]
    best: tuple[tuple[int, int], Any] = ((0, 0), None)
    for run in np.unique(driven.reshape(len(driven), -1), axis=0).reshape(-1, *driven.shape[1:]):
        for seeds in np.unique(run[run.any(1)], axis=0):
            cells = run[:, seeds].all(1)
            runs = driven[:, cells][..., seeds].all((1, 2))
            size = (int(runs.sum()) * int(cells.sum()) * int(seeds.sum()), int(runs.sum()))
            if size > best[0]:
                best = (size, tuple(map(np.flatnonzero, (runs, cells, seeds))))
    return best[1]


def _places(values: Sequence[object], wanted: Collection[object] | None) -> list[int]:
    kept = None if wanted is None else set(wanted)
    return [place for place, value in enumerate(values) if kept is None or value in kept]


def _distinct(column: pa.ChunkedArray) -> tuple[list[Any], NDArray[np.int64]]:
    """The distinct values of a column, ascending, and the index of each record's value among them."""
    encoded = column.combine_chunks()
    encoded = encoded if pa.types.is_dictionary(encoded.type) else encoded.dictionary_encode()
    values, codes = encoded.dictionary.to_pylist(), encoded.indices.to_numpy()
    used = np.flatnonzero(np.bincount(codes, minlength=len(values))).tolist()
    ascending = sorted(used, key=lambda code: values[code])
    place = np.zeros(len(values), np.int64)
    place[ascending] = np.arange(len(ascending))
    return [values[code] for code in ascending], place[codes]


def axes_of(records: pa.Table) -> Axes:
    """The axes of the world that records are of."""
    return _read_axes(records["world_facts"][0].as_py())


@cache
def _read_axes(world_facts: str) -> Axes:
    return Axes.read(json.loads(world_facts)["axes"])


@cache
def _read_cell(text: str) -> Cell:
    return Cell(**json.loads(text))


def as_text(cell: Cell) -> str:
    """A cell as JSON, as in records."""
    return json.dumps(dict(cell), separators=(",", ":"))


def _cells(records: pa.Table, axes: Axes) -> tuple[list[Cell], NDArray[np.int64]]:
    """The cells of some records in the order of tables, and the index of each record's cell among them."""
    texts, code = _distinct(records["cell"])
    cells = [_read_cell(text) for text in texts]
    order = sorted(range(len(cells)), key=lambda place: axes.place(cells[place]))
    place = np.empty(len(cells), np.int64)
    place[order] = np.arange(len(cells))
    return [cells[number] for number in order], place[code]


def shared(first: Episodes, second: Episodes) -> tuple[Episodes, Episodes]:
    """Reduce both to the runs, cells and scenario seeds that they have in common.

    Raises:
        ValueError: if they have nothing in common.
    """
    if (first.runs, first.cells, first.seeds) == (second.runs, second.cells, second.seeds):
        return first, second
    runs, cells, seeds = (set(getattr(first, name)) & set(getattr(second, name)) for name in ("runs", "cells", "seeds"))
    return first.only(runs=runs, cells=cells, seeds=seeds), second.only(runs=runs, cells=cells, seeds=seeds)


def difference(treated: Episodes, control: Episodes, name: str) -> Interval:
    """Mean of `treated` - `control`, paired by training seed, cell and scenario seed.

    Raises:
        ValueError: if runs, cells or scenario seeds differ: the difference would then include that of the traffic.
    """
    if (treated.runs, treated.cells, treated.seeds) != (control.runs, control.cells, control.seeds):
        raise ValueError("not paired: the two sides differ in training seeds, cells or scenario seeds (see `shared`)")
    return interval(treated.column(name) - control.column(name))


def measured(episodes: Episodes, measure: Measure) -> Interval:
    """Aggregate some episodes by a measure; the bounds are NaN if it has no interval, or was not measured in all episodes."""
    if measure.how == "mean":
        scores = episodes.column(measure.column)
        if (missing := np.isnan(scores)).any():
            return Interval(float(scores[~missing].mean()) if not missing.all() else np.nan, np.nan, np.nan)
        return share_interval(scores) if measure.unit == "share" else interval(scores)
    if measure.how == "step mean":
        return Interval(step_mean(episodes, measure.column), np.nan, np.nan)
    return Interval(float(np.median(episodes.column(measure.column))), np.nan, np.nan)


def step_mean(episodes: Episodes, name: str) -> float:
    """Mean over all steps of a column of means over the steps of an episode."""
    steps = episodes.column("steps")
    return float((episodes.column(name) * steps).sum() / max(float(steps.sum()), 1.0))
