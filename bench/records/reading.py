"""Reads the records of a results folder: the newest of everything, or those of some units."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from bench.errors import UserError
from bench.plugins import track as of
from bench.plugins.track import Track
from bench.records import validity
from bench.records.generations import check, glance, selection
from bench.records.schema import IDENTITY, PROVENANCE, schema
from bench.records.store import FOLDER, path_of


def read_all(out: Path) -> dict[str, pa.Table]:
    """The newest records of each track that a results folder has records of.

    Raises:
        UserError: if there are no records, or if a file is truncated or foreign.
    """
    there = {check(path)[0].name for path in _paths(out)}
    return {track.name: read(out, track=track) for track in of.tracks() if track.name in there}


def read(out: Path, units: Collection[str] | None = None, *, track: Track) -> pa.Table:
    """Records of one track as a table of its schema, ordered by pair, training seed, cell and scenario seed.

    Args:
        out: results folder.
        track: whose records; those of the other are left alone.
        units: fingerprints of the units to read. None reads the newest result of everything that is there: of each pair
            and training seed only what the newest code and weights made, and of a scenario driven twice the last one.

    Raises:
        UserError: if there are no records, or if a file is truncated or foreign, or has values that cannot be.
    """
    paths = _paths(out) if units is None else [path_of(out, unit) for unit in sorted(set(units))]
    known = [(path, generation) for path in paths for found, generation in [check(path)] if found.name == track.name]
    if not known:
        raise UserError(_NOTHING.format(out=out))
    query = "from records" + (_NEWEST if units is None else "") + _ORDER
    with _records(out, known, track) as connection:
        records = connection.sql(query).to_arrow_table().cast(schema(track))
    return _valid(records, out, track)


def _paths(out: Path) -> list[Path]:
    paths = sorted((out / FOLDER).glob("[!.]*.parquet"))
    if not paths:
        raise UserError(_NOTHING.format(out=out))
    return paths


def _valid(records: pa.Table, out: Path, track: Track) -> pa.Table:
    """Records as they are; refused, and their file named, if a value cannot be."""
    if found := validity.complaint(records, schema(track)):
        row, why = found
        path = path_of(out, records["unit"][row].as_py())
        named = f"the record {path}" if path.exists() else f"a record in {out} (unit {path.stem})"
        raise UserError(f"{named} cannot be right: {why}; delete it and run again to make it anew")
    return records


def read_compact(out: Path, measurements: Collection[str]) -> dict[str, pa.Table]:
    """The newest records of each track as `read` would choose them, small enough for a million: for leaderboards.

    Text columns are dictionaries. Of the measurements only those asked for are there, and the probes.

    Args:
        out: results folder.
        measurements: names of columns that hold no lists, of any track.

    Raises:
        UserError: if there are no records, or if a file is truncated or foreign, or has values that cannot be.
    """
    known: dict[str, list[tuple[Path, pa.Schema]]] = {}
    for path in _paths(out):
        track, generation = glance(path)
        known.setdefault(track.name, []).append((path, generation))
    there = [track for track in of.tracks() if track.name in known]
    return {track.name: _read_compact(out, known[track.name], track, measurements) for track in there}


def _read_compact(
    out: Path, known: Sequence[tuple[Path, pa.Schema]], track: Track, measurements: Collection[str]
) -> pa.Table:
    """A row a unit, as what its episodes share is most of a record, with its episodes as lists; these are laid out then."""
    shared = [field.name for field in (*IDENTITY, *PROVENANCE) if field.name not in ("unit", "seed")]
    wanted = [field.name for field in track.measurements if field.name in measurements]
    wanted += [field.name for field in track.probes]
    once = ", ".join(f'any_value("{name}") as "{name}"' for name in shared)
    lists = ", ".join(f'list("{name}") as "{name}"' for name in ("seed", *wanted))
    with _records(out, known, track) as connection:
        connection.sql("set preserve_insertion_order = false")
        units = connection.sql(f"select unit, {once}, {lists} from records group by unit").to_arrow_table()
        alone = units.select(["unit", *shared]).append_column("row", pa.array(range(units.num_rows)))
        connection.register("alone", alone)
        newest = connection.sql(f"select row from alone {_NEWEST_UNITS} {_UNIT_ORDER}").to_arrow_table()
    units = units.take(newest["row"]).combine_chunks()
    rows = np.repeat(np.arange(units.num_rows), pc.list_value_length(units["seed"]).to_numpy())
    names = [name for name in schema(track).names if name in units.column_names]
    return _valid(pa.table({name: _laid_out(units[name].chunk(0), rows) for name in names}), out, track)


def _laid_out(column: pa.Array, rows: NDArray[np.int64]) -> pa.Array:
    """A column of units as one of their episodes: lists are unpacked, text becomes a dictionary."""
    if pa.types.is_list(column.type):
        return column.flatten()
    if pa.types.is_string(column.type):
        encoded = column.dictionary_encode()
        return pa.DictionaryArray.from_arrays(encoded.indices.to_numpy()[rows], encoded.dictionary)
    return column.take(pa.array(rows))


@contextmanager
def _records(out: Path, known: Sequence[tuple[Path, pa.Schema]], track: Track) -> Iterator[duckdb.DuckDBPyConnection]:
    """A connection whose view `records` is what is in files of one track; a file that cannot be read is named."""
    by_columns: dict[pa.Schema, list[str]] = {}
    for path, generation in known:
        by_columns.setdefault(generation, []).append("'" + str(path).replace("'", "''") + "'")
    parts = [
        f"select {selection(track, generation)} from read_parquet([{', '.join(paths)}])"
        for generation, paths in by_columns.items()
    ]
    try:
        with duckdb.connect() as connection:
            connection.sql("create view records as " + " union all by name ".join(parts))
            yield connection
    except duckdb.Error as error:
        for path, _ in known:
            check(path, thoroughly=True)
        raise UserError(f"the records in {out} cannot be read: {str(error).splitlines()[0]}") from error


_NOTHING = "there are no records in {out}; `bench run out={out}` makes some"
_NEWEST = """
    qualify (code_digest, weights_sha256) = first_value((code_digest, weights_sha256)) over (
        partition by pair, training_seed order by created_at desc, unit)
    and row_number() over (
        partition by pair, training_seed, cell, seed order by created_at desc, unit) = 1
"""
_NEWEST_UNITS = """
    qualify (code_digest, weights_sha256) = first_value((code_digest, weights_sha256)) over (
        partition by pair, training_seed order by created_at desc, unit)
"""
"""The same of units; of a scenario that two of them drove, the reader keeps the last."""
_UNIT_ORDER = " order by pair, training_seed, cell, created_at"
_ORDER = " order by pair, training_seed, cell, seed"
