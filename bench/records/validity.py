"""Checks the values of records: numbers are in the ranges of their columns; cells, names and JSON can be read."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import get_args

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from cavbench.core import sets
from cavbench.core.contracts import Access
from cavbench.core.track import Track
from cavbench.errors import short
from cavbench.records.schema import LARGEST, schema
from cavbench.records.table import group_codes, of_texts
from cavbench.scenarios import Axes

JSON = ("attack_params", "defense_params", "victim_params", "world_params", "libraries")
LONGEST_TEXT = 100_000
"""Most bytes of a text: a table with a name of millions of characters takes minutes."""
FACTS: Mapping[str, object] = {"decision_hz": 0, "max_steps": 0, "actions": [""]}
"""Facts that every world has, with values of their types."""


def complaint(records: pa.Table, track: Track) -> tuple[int, str] | None:
    """The first row with an invalid value, and why it is invalid; None if all rows are valid.

    Args:
        records: columns of `cavbench.records.schema`, maybe not all; text may be dictionary-encoded.
        track: track of the records.
    """
    problems = [*_out_of_range(records, schema(track)), *_too_long(records), *_not_a_date(records)]
    return min(problems, default=None) or min(_unreadable(records, track), default=None)


def unlike(records: pa.Table, unit: NDArray[np.int64], shared: Sequence[str]) -> tuple[int, str] | None:
    """The first row that differs from its unit in a column that all rows of a unit share, and why; None if all agree.

    Args:
        records: text may be dictionary-encoded.
        unit: a number for the unit of each row [N].
        shared: names of columns.
    """
    found, first = np.unique(unit, return_index=True)
    of_unit = np.empty(int(found.max(initial=-1)) + 1, np.int64)
    of_unit[found] = first
    for name in shared:
        values = group_codes(records, (name,))
        if (wrong := values != values[of_unit[unit]]).any():
            row = int(wrong.argmax())
            first_said, said = (short(str(records[name][at])) for at in (int(of_unit[unit[row]]), row))
            return row, f"its rows differ in {name}: {first_said}, {said}"
    return None


def _out_of_range(records: pa.Table, columns: pa.Schema) -> Iterator[tuple[int, str]]:
    """Problems of numbers: each column says its range (`cavbench.records.schema.field`)."""
    for column in columns:
        flat = column.type.value_type if pa.types.is_list(column.type) else column.type
        if column.name not in records.column_names or not (pa.types.is_floating(flat) or pa.types.is_integer(flat)):
            continue
        rows, values = _numbers(records[column.name])
        low, high, fact = (column.metadata[key] for key in (b"low", b"high", b"at_most"))
        most = _facts(records["world_facts"], fact.decode())[rows] if fact else np.inf
        wrong = ~((values >= float(low)) & (values <= np.minimum(float(high), most)))
        if column.nullable:
            wrong &= ~np.isnan(values)
        if wrong.any():
            first = int(wrong.argmax())
            limit = float(np.broadcast_to(np.minimum(float(high), most), values.shape)[first])
            yield int(rows[first]), f"{column.name} must be {_range(float(low), limit)}, got {values[first]:g}"


def _numbers(column: pa.ChunkedArray) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The numbers of a column or of its lists, with their rows; NaN where there is none."""
    whole = column.combine_chunks()
    if not pa.types.is_list(whole.type):
        return np.arange(len(whole)), whole.to_numpy(zero_copy_only=False).astype(np.float64)
    rows = np.repeat(np.arange(len(whole)), pc.fill_null(pc.list_value_length(whole), 0).to_numpy())
    return rows, whole.flatten().to_numpy(zero_copy_only=False).astype(np.float64)


def _facts(column: pa.ChunkedArray, name: str) -> NDArray[np.float64]:
    """A fact of the world in each row; infinity where a world does not say it, or says 0."""
    encoded = column.combine_chunks()
    if not pa.types.is_dictionary(encoded.type):
        encoded = encoded.dictionary_encode()
    found = []
    for text in encoded.dictionary.to_pylist():
        try:
            fact = json.loads(text)[name]
        # `_unreadable` complains of facts that cannot be read.
        except (ValueError, KeyError, TypeError, RecursionError):
            fact = 0
        found.append(float(fact) if isinstance(fact, int | float) and fact else np.inf)
    return np.array(found)[encoded.indices.to_numpy(zero_copy_only=False)]


def _range(low: float, high: float) -> str:
    if high == np.inf:
        return f"at least {low:g}"
    return f"between {low:g} and {high:g}"


def _too_long(records: pa.Table) -> Iterator[tuple[int, str]]:
    for name, column in zip(records.column_names, records.columns, strict=True):
        whole = column.combine_chunks()
        encoded = pa.types.is_dictionary(whole.type)
        texts = whole.dictionary if encoded else whole
        if not pa.types.is_string(texts.type):
            continue
        long = pc.fill_null(pc.greater(pc.binary_length(texts), LONGEST_TEXT), False).to_numpy(zero_copy_only=False)
        rows = np.append(long, False)[of_texts(whole)] if encoded else long
        if rows.any():
            yield int(rows.argmax()), f"{name} has more than {LONGEST_TEXT} bytes"


def _not_a_date(records: pa.Table) -> Iterator[tuple[int, str]]:
    """Times that Python cannot hold."""
    if "created_at" not in records.column_names:
        return
    first, last = (int(end.replace(tzinfo=UTC).timestamp()) * 10**6 for end in (datetime.min, datetime.max))
    created = records["created_at"].cast(pa.int64()).to_numpy()
    if (wrong := (created < first) | (created > last)).any():
        yield int(wrong.argmax()), "created_at must be in the years 1 to 9999"


def _unreadable(records: pa.Table, track: Track) -> Iterator[tuple[int, str]]:
    """Problems of texts and cells; each distinct value is checked once."""
    yield from _refused(records, ("cell", "world_facts"), partial(_cell, example={**FACTS, **track.facts}))
    yield from _refused(records, ("threat_access",), partial(_known, known=get_args(Access)))
    if track.norms:
        yield from _refused(records, ("threat_norm",), partial(_norm, known=track.norms))
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
            yield row, f"{names[0]} {short(str(values[0]))}: {error}"
        except RecursionError:
            yield row, f"{' or '.join(names)} {short(str(values[0]))}: nested too deeply"


def _cell(cell: str, facts: str, example: Mapping[str, object]) -> None:
    values, world = json.loads(cell), json.loads(facts)
    if not (isinstance(values, dict) and isinstance(world, dict) and isinstance(world.get("axes"), list)):
        raise ValueError("not a cell, or world_facts has no axes")
    Axes.read(world["axes"]).cell(**values)
    for name, value in example.items():
        if name in FACTS and name not in world:
            raise ValueError(f"world_facts has no {name}")
        if name in world and not _alike(world[name], value):
            raise ValueError(f"world_facts has a wrong {name}: {short(str(world[name]))}")
        # Where a world has decisions, the example has some per second, and an episode has at least one.
        if name in FACTS and isinstance(value, int) and value and not world[name]:
            raise ValueError(f"world_facts has a wrong {name}: it must be above 0")


def _alike(value: object, example: object) -> bool:
    """Whether a JSON value has the types of an example. Numbers are finite and at least 0; a list or an object may be empty."""
    if isinstance(example, Mapping):
        return isinstance(value, dict) and all(_alike(value[key], example[key]) for key in example if key in value)
    if isinstance(example, list):
        return isinstance(value, list) and all(_alike(one, example[0]) for one in value if example)
    if isinstance(example, str):
        return isinstance(value, str)
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= LARGEST


def _known(name: str, known: Sequence[str]) -> None:
    if name not in known:
        raise ValueError(f"known: {', '.join(known)}")


def _norm(text: str, known: Sequence[str]) -> None:
    """A perturbation set, with the other sets of its threat model."""
    _known(sets.split(text)[0], known)


def _object(text: str) -> None:
    if not isinstance(json.loads(text), dict):
        raise ValueError("not a JSON object")
