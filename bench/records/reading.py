"""Reads the records of a results folder: the newest of all units, or those of some units."""

from __future__ import annotations

import glob
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TypeVar

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cavbench.core import track as of
from cavbench.core.track import Track
from cavbench.errors import UserError, notice, short
from cavbench.records import validity
from cavbench.records.columns import glance, track_of
from cavbench.records.packing import units_in
from cavbench.records.schema import IDENTITY, PROVENANCE, schema
from cavbench.records.store import FOLDER, MANY, path_of

T = TypeVar("T")

SKEW = timedelta(hours=1)
"""Clocks of machines may differ so much; a record that is dated further ahead is not believed to be the newest."""
TRIES = 5
"""Most attempts to read a folder in which a run packs files."""


def read_all(out: Path) -> dict[str, pa.Table]:
    """The newest records of each track in a results folder.

    Raises:
        UserError: as `read`.
    """
    return _settled(out, partial(_read_all, out))


def _read_all(out: Path) -> dict[str, pa.Table]:
    present = {track_of(path).name for path in _paths(out)}
    return {track.name: _read(out, None, track) for track in of.tracks() if track.name in present}


def read(out: Path, units: Collection[str] | None = None, *, track: Track) -> pa.Table:
    """Records of one track as a table of its schema, ordered by pair, training seed, cell and scenario seed.

    Args:
        out: results folder.
        track: track to read; records of other tracks are skipped.
        units: fingerprints of the units to read. None reads the newest results: for each pair and training seed only those of
            the newest code and weights, and for a scenario that was driven twice only the last.

    Raises:
        UserError: if there are no records, or a file is truncated, foreign, or has invalid values.
    """
    return _settled(out, partial(_read, out, units, track))


def _read(out: Path, units: Collection[str] | None, track: Track) -> pa.Table:
    paths = _paths(out) if units is None else _paths_of(out, set(units))
    known = [path for path in paths if track_of(path).name == track.name]
    if not known:
        raise UserError(_NOTHING.format(out=out))
    names = ", ".join(f'"{name}"' for name in schema(track).names)
    query = f"select {names} from records" + (_NEWEST if units is None else _OF_UNITS) + _ORDER
    with _records(out, known, track) as connection:
        if twice := connection.sql(_TWICE).fetchall():
            raise UserError(_DOUBLED.format(unit=short(twice[0][0]), out=out))
        if units is not None:
            connection.register("wanted", pa.table({"unit": sorted(units)}))
        records = connection.sql(query).to_arrow_table()
    return _valid(records.cast(schema(track)), out, track)


def read_file(path: Path) -> pa.Table:
    """All records of one file, as a table of its track's schema.

    Raises:
        UserError: if the file is truncated or foreign.
    """
    columns = schema(track_of(path))
    return pq.read_table(path).cast(columns)


def _paths(out: Path) -> list[Path]:
    """The files of records. Listed until nothing changes: during a packing, a listing may miss the new file and the old ones."""
    paths, before = _listing(out), None
    while paths != before:
        paths, before = _listing(out), paths
    if not paths:
        raise UserError(_NOTHING.format(out=out))
    return paths


def _listing(out: Path) -> list[Path]:
    return sorted((out / FOLDER).glob("[!.]*.parquet"))


def _paths_of(out: Path, units: set[str]) -> list[Path]:
    """The files that hold these units; a unit that is nowhere is looked for under its own name."""
    there = {path.stem: path for path in _paths(out)}
    single = [there[unit] for unit in sorted(units & there.keys())]
    missing = units - there.keys()
    packed = []
    for path in there.values():
        if missing and path.name.startswith(MANY) and (here := missing & units_in(path)):
            packed.append(path)
            missing -= here
    return [*single, *packed, *(path_of(out, unit) for unit in sorted(missing))]


def _settled(out: Path, reads: Callable[[], T]) -> T:
    """What `reads` returns; it is repeated if it fails while a run packs files."""
    for _ in range(TRIES):
        before = _listing(out)
        try:
            return reads()
        except UserError:
            if _listing(out) == before:
                raise
    return reads()


def _valid(records: pa.Table, out: Path, track: Track) -> pa.Table:
    """The records, unchanged; UserError with the name of the file if a value is invalid."""
    if problem := validity.complaint(records, track):
        row, why = problem
        path = path_of(out, records["unit"][row].as_py())
        if path.exists():
            raise UserError(f"the record {path} is invalid: {why}; delete it and run again to recreate it")
        raise UserError(f"a record in {out} (unit {path.stem}) is invalid: {why}; run again to recreate it")
    return records


def times(records: pa.Table) -> NDArray[np.int64]:
    """When records were created, in microseconds, to find the newest; 0 for those from the future."""
    created = records["created_at"]
    return np.where(pc.greater(created, _latest()).to_numpy(), 0, created.cast(pa.int64()).to_numpy())


def _latest() -> datetime:
    """The latest time that is believed: now, and as much as clocks differ."""
    return datetime.now(UTC) + SKEW


def read_compact(out: Path, measurements: Collection[str]) -> dict[str, pa.Table]:
    """The newest records of each track, as in `read_all`, in a compact form for leaderboards of a million records.

    Text columns are dictionary-encoded. Only the given measurements, and the probes, are read.

    Args:
        out: results folder.
        measurements: names of columns of any track, without lists.

    Raises:
        UserError: if there are no records, or a file is truncated, foreign, or has invalid values.
    """
    return _settled(out, partial(_read_all_compact, out, measurements))


def _read_all_compact(out: Path, measurements: Collection[str]) -> dict[str, pa.Table]:
    known: dict[str, list[Path]] = {}
    for path in _paths(out):
        known.setdefault(glance(path).name, []).append(path)
    present = [track for track in of.tracks() if track.name in known]
    return {track.name: _read_compact(out, known[track.name], track, measurements) for track in present}


def _read_compact(out: Path, known: Sequence[Path], track: Track, measurements: Collection[str]) -> pa.Table:
    """Read one row per unit, with its episodes as lists, then expand the lists: most of a record is shared by its unit."""
    shared = [field.name for field in (*IDENTITY, *PROVENANCE) if field.name not in ("unit", "seed")]
    wanted = [field.name for field in track.measurements if field.name in measurements]
    wanted += [field.name for field in track.probes]
    once = ", ".join(f'any_value("{name}") as "{name}"' for name in shared)
    lists = ", ".join(f'list("{name}") as "{name}"' for name in ("seed", *wanted))
    with _records(out, known, track) as connection:
        connection.sql("set preserve_insertion_order = false")
        query = f"select unit, {once}, {lists}, file from records group by unit, file {_ONCE}"
        units = connection.sql(query).to_arrow_table()
        alone = units.select(["unit", *shared]).append_column("row", pa.array(range(units.num_rows)))
        connection.register("alone", alone)
        newest = connection.sql(f"select row from alone {_NEWEST_UNITS} {_UNIT_ORDER}").to_arrow_table()
    units = units.take(newest["row"]).combine_chunks()
    _check_distinct(units, out)
    rows = np.repeat(np.arange(units.num_rows), pc.list_value_length(units["seed"]).to_numpy())
    names = [name for name in schema(track).names if name in units.column_names]
    return _valid(pa.table({name: _laid_out(units[name].combine_chunks(), rows) for name in names}), out, track)


def _check_distinct(units: pa.Table, out: Path) -> None:
    """Raise UserError if a file has an episode twice."""
    seeds = units["seed"].chunk(0) if units.num_rows else pa.array([], pa.list_(pa.int64()))
    owner = np.repeat(np.arange(len(seeds)), pc.list_value_length(seeds).to_numpy())
    order = np.lexsort((flat := seeds.flatten().to_numpy(), owner))
    twice = (np.diff(flat[order]) == 0) & (np.diff(owner[order]) == 0)
    if twice.any():
        unit = units["unit"][int(owner[order][:-1][twice][0])].as_py()
        raise UserError(_DOUBLED.format(unit=short(unit), out=out))


def _laid_out(column: pa.Array, rows: NDArray[np.int64]) -> pa.Array:
    """Expand a column of units to one of episodes: lists are flattened, text is dictionary-encoded."""
    if pa.types.is_list(column.type):
        return column.flatten()
    if pa.types.is_string(column.type):
        encoded = column.dictionary_encode()
        return pa.DictionaryArray.from_arrays(encoded.indices.take(pa.array(rows)), encoded.dictionary)
    return column.take(pa.array(rows))


@contextmanager
def _records(out: Path, known: Sequence[Path], track: Track) -> Iterator[duckdb.DuckDBPyConnection]:
    """A connection with the view `records` of the files of one track; UserError with the name of an unreadable file."""
    names = ", ".join(f'"{name}"' for name in schema(track).names)
    paths = ", ".join("'" + glob.escape(str(path)).replace("'", "''") + "'" for path in known)
    files = f"read_parquet([{paths}], filename = true, hive_partitioning = false)"
    try:
        with duckdb.connect() as connection:
            # After two seconds it would write a progress bar to standard output, between our tables.
            connection.execute("set enable_progress_bar = false")
            # A file of somebody else may state other bounds of its values than it has, to hide rows from one reader only.
            connection.execute(f"set disabled_optimizers = '{_BY_STATISTICS}'")
            connection.sql(f"create view records as select {names}, filename as file from {files}")
            connection.execute("set variable latest = ?", [_latest()])
            future = "select file from records where created_at > getvariable('latest') limit 1"
            if ahead := connection.execute(future).fetchall():
                notice(f"the record {ahead[0][0]} is dated in the future: such records count as older than all others")
            yield connection
    except duckdb.Error as error:
        for path in known:
            track_of(path, thoroughly=True)
        raise UserError(f"the records in {out} cannot be read: {str(error).splitlines()[0]}") from error


_BY_STATISTICS = "filter_pushdown,join_filter_pushdown,statistics_propagation"
"""What DuckDB would leave out, or fill in, by the bounds that a file states."""
_NOTHING = "there are no records in {out}; create some with `bench run out={out}`"
_DOUBLED = "the records of unit {unit} in {out} have an episode twice; delete them and run again"
_TWICE = "select unit from records group by unit, seed, file having count(*) > 1 limit 1"
"""A unit that has an episode twice in one file. In two files it has it after a packing that was killed, or in a copy."""
_BELIEVED = "created_at <= getvariable('latest') desc, created_at desc"
"""Newest first; records from the future last."""
_WHOSE = f"""
    (code_digest, weights_sha256) = first_value((code_digest, weights_sha256)) over (
        partition by pair, training_seed, grid = 'audit' order by {_BELIEVED}, unit)
"""
_NEWEST = f"""
    qualify {_WHOSE} and row_number() over (
        partition by pair, training_seed, cell, seed order by {_BELIEVED}, unit) = 1
"""
_NEWEST_UNITS = f" qualify {_WHOSE}"
"""The same for units; if two of them drove a scenario, the caller keeps the last."""
_BY_FILE = "ends_with(file, '/' || unit || '.parquet') desc, file"
"""Of a unit in several files, for instance copies: the file of its name, or the first."""
_OF_UNITS = f"""
    where unit in (select unit from wanted) qualify row_number() over (partition by unit, seed order by {_BY_FILE}) = 1
"""
_ONCE = f" qualify row_number() over (partition by unit order by {_BY_FILE}) = 1"
_UNIT_ORDER = " order by pair, training_seed, cell, created_at <= getvariable('latest'), created_at"
_ORDER = " order by pair, training_seed, cell, seed"
