"""Checks the values of records: shares are in [0, 1]; cells, access levels and JSON can be read."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from typing import get_args

import numpy as np
import pyarrow as pa

from bench.plugins.contracts import Access
from bench.scenarios import Axes

JSON = ("attack_params", "defense_params", "victim_params", "world_params", "libraries")


def complaint(records: pa.Table, schema: pa.Schema) -> tuple[int, str] | None:
    """The first row with an invalid value, and why it is invalid; None if all rows are valid.

    Args:
        records: columns of `bench.records.schema`; text may be dictionary-encoded.
        schema: schema of the records, which may lack some of its columns.
    """
    problems = [*_out_of_range(records, schema), *_unreadable(records)]
    return min(problems, default=None)


def _out_of_range(records: pa.Table, schema: pa.Schema) -> Iterator[tuple[int, str]]:
    """Problems of shares and confidences: numbers whose unit ends with "0 to 1"."""
    for field in schema:
        share = field.type == pa.float64() and field.metadata[b"unit"].endswith(b"0 to 1")
        if not share or field.name not in records.column_names:
            continue
        values = records[field.name].to_numpy()
        wrong = ~((values >= 0) & (values <= 1))
        if field.nullable:
            wrong &= ~np.isnan(values)
        if wrong.any():
            row = int(wrong.argmax())
            yield row, f"{field.name} must be between 0 and 1, got {values[row]:g}"


def _unreadable(records: pa.Table) -> Iterator[tuple[int, str]]:
    """Problems of texts and cells; each distinct value is checked once."""
    yield from _refused(records, ("cell", "world_facts"), _cell)
    yield from _refused(records, ("threat_access",), _access)
    for name in JSON:
        yield from _refused(records, (name,), _object)


def _refused(records: pa.Table, names: Sequence[str], check: Callable[..., object]) -> Iterator[tuple[int, str]]:
    """The first row of each distinct combination of values in these columns for which `check` raises ValueError."""
    codes = np.zeros(records.num_rows, np.int64)
    for name in names:
        encoded = records[name].combine_chunks()
        if not pa.types.is_dictionary(encoded.type):
            encoded = encoded.dictionary_encode(null_encoding="encode")
        codes = codes * (len(encoded.dictionary) + 1) + encoded.indices.to_numpy(zero_copy_only=False)
    first = np.full(codes.max(initial=0) + 1, -1)
    first[codes[::-1]] = np.arange(len(codes))[::-1]
    for row in first[first >= 0].tolist():
        values = [records[name][row].as_py() for name in names]
        try:
            check(*values)
        except ValueError as error:
            yield row, f"{names[0]} {values[0]}: {error}"


def _cell(cell: str, facts: str) -> None:
    values, world = json.loads(cell), json.loads(facts)
    if not (isinstance(values, dict) and isinstance(world, dict) and isinstance(world.get("axes"), list)):
        raise ValueError("not a cell, or world_facts has no axes")
    Axes.read(world["axes"]).cell(**values)


def _access(name: str) -> None:
    if name not in get_args(Access):
        raise ValueError(f"known: {', '.join(get_args(Access))}")


def _object(text: str) -> None:
    if not isinstance(json.loads(text), dict):
        raise ValueError("not a JSON object")
