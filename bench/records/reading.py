"""Reads the records of a results folder: the newest of all units, or those of some units.

Reports read text dictionary-encoded: a million records take a sixth of the memory then, and rows are compared by numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from cavbench.core import track as of
from cavbench.core.track import Track
from cavbench.errors import UserError, notice, short
from cavbench.records import validity
from cavbench.records.columns import track_of
from cavbench.records.packing import units_in
from cavbench.records.schema import AUDIT, IDENTITY, PROVENANCE, encoded, schema
from cavbench.records.store import FOLDER, MANY, path_of
from cavbench.records.table import group_codes, plain, read_table, together

T = TypeVar("T")

SKEW = timedelta(hours=1)
"""Clocks of machines may differ so much; a record that is dated further ahead is not believed to be the newest."""
TRIES = 5
"""Most attempts to read a folder in which a run packs files."""
SHARED = tuple(field.name for field in (*IDENTITY, *PROVENANCE) if field.name not in ("unit", "seed"))
"""The columns that have one value in all rows of a unit."""


def read_all(out: Path, measurements: Collection[str] | None = None) -> dict[str, pa.Table]:
    """The newest records of each track in a results folder, ordered as by `read`; text is dictionary-encoded.

    Args:
        out: results folder.
        measurements: names of columns of any track; of the measurements, only these are read. None reads all.

    Raises:
        UserError: as `read`.
    """
    return _settled(out, partial(_read_all, out, measurements))


def _read_all(out: Path, measurements: Collection[str] | None) -> dict[str, pa.Table]:
    known: dict[str, list[Path]] = {}
    for path in _paths(out):
        known.setdefault(track_of(path).name, []).append(path)
    present = [track for track in of.tracks() if track.name in known]
    return {track.name: _newest(_load(out, known[track.name], track, measurements)) for track in present}


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
    records = _load(out, known, track, None)
    if units is None:
        return plain(_newest(records))
    return plain(_ordered(records.filter(pc.is_in(records["unit"], pa.array(sorted(units), pa.string())))))


def read_file(path: Path) -> pa.Table:
    """All records of one file, as a table of its track's schema, with dictionary-encoded text.

    Raises:
        UserError: if the file is truncated or foreign.
    """
    return read_table(path, track_of(path))


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


def _load(out: Path, known: Sequence[Path], track: Track, measurements: Collection[str] | None) -> pa.Table:
    """All records of some files of a track, each unit once, and checked."""
    measured = {field.name for field in track.measurements}
    dropped = set() if measurements is None else measured - set(measurements)
    names = [name for name in schema(track).names if name not in dropped]
    tables = [read_table(path, track, names) for path in known]
    rows = np.repeat(np.arange(len(known)), [table.num_rows for table in tables])
    records = together([encoded(track, names).empty_table(), *tables])
    unit = group_codes(records, ("unit",))
    records, unit = _once(records, unit, rows, known)
    _check_distinct(records, unit, out)
    _check(records, unit, out, track)
    _notice_future(known, tables)
    return records


def _once(
    records: pa.Table, unit: NDArray[np.int64], rows: NDArray[np.int64], known: Sequence[Path]
) -> tuple[pa.Table, NDArray[np.int64]]:
    """The records without copies: of a unit in several files that of its name counts, or else the first.

    Args:
        records: of all files.
        unit: a number for the unit of each record [N].
        rows: the file of each record, as a place in `known` [N].
        known: the files, sorted.
    """
    alone = {path.stem: place for place, path in enumerate(known)}
    found, first = np.unique(unit, return_index=True)
    own = np.array([alone.get(name, -1) for name in records["unit"].take(pa.array(first)).to_pylist()], np.int64)
    lowest = np.full(len(found), len(known), np.int64)
    np.minimum.at(lowest, unit, rows)
    in_its_own = np.zeros(len(found), bool)
    in_its_own[unit[rows == own[unit]]] = True
    keep = rows == np.where(in_its_own, own, lowest)[unit]
    if keep.all():
        return records, unit
    return records.filter(pa.array(keep)), unit[keep]


def _check_distinct(records: pa.Table, unit: NDArray[np.int64], out: Path) -> None:
    """Raise UserError if a unit has an episode twice."""
    seeds = records["seed"].to_numpy()
    order = np.lexsort((seeds, unit))
    twice = (np.diff(seeds[order]) == 0) & (np.diff(unit[order]) == 0)
    if twice.any():
        name = records["unit"][int(order[:-1][twice][0])].as_py()
        raise UserError(f"the records of unit {short(name)} in {out} have an episode twice; delete them and run again")


def _check(records: pa.Table, unit: NDArray[np.int64], out: Path, track: Track) -> None:
    """Raise UserError with the name of the file if a value is invalid, or a unit's rows differ in what they share."""
    if problem := validity.complaint(records, track) or validity.unlike(records, unit, SHARED):
        row, why = problem
        path = path_of(out, records["unit"][row].as_py())
        if path.exists():
            raise UserError(f"the record {path} is invalid: {why}; delete it and run again to recreate it")
        raise UserError(f"a record in {out} (unit {path.stem}) is invalid: {why}; run again to recreate it")


def _newest(records: pa.Table) -> pa.Table:
    """Of each pair and training seed the records of the newest code and weights, and of a scenario driven twice the last."""
    if not records.num_rows:
        return records
    age = _age(records)
    audit = pc.equal(records["grid"], AUDIT).to_numpy(zero_copy_only=False)
    whose = np.unique(group_codes(records, ("pair", "training_seed")) * 2 + audit, return_inverse=True)[1]
    made = group_codes(records, ("code_digest", "weights_sha256"))
    keep = made == made[_first_of(whose, age)][whose]
    kept, age = records.filter(pa.array(keep)), age[keep]
    scenario = group_codes(kept, ("pair", "training_seed", "cell", "seed"))
    return _ordered(kept.take(pa.array(_first_of(scenario, age))))


def _age(records: pa.Table) -> NDArray[np.int64]:
    """A rank of each record, 0 for the newest; those from the future are the oldest, and units of one time are in their order."""
    created = records["created_at"]
    ahead = pc.greater(created, _latest()).to_numpy(zero_copy_only=False)
    order = np.lexsort((_places(records["unit"]), -created.cast(pa.int64()).to_numpy(), ahead))
    ranks = np.empty(len(order), np.int64)
    ranks[order] = np.arange(len(order))
    return ranks


def _notice_future(known: Sequence[Path], tables: Sequence[pa.Table]) -> None:
    latest = _latest()
    for path, table in zip(known, tables, strict=True):
        if table.num_rows and pc.max(table["created_at"].cast(pa.int64())).as_py() > latest.timestamp() * 1e6:
            notice(f"the record {path} is dated in the future: such records count as older than all others")
            return


def _first_of(groups: NDArray[np.int64], ranks: NDArray[np.int64]) -> NDArray[np.int64]:
    """The place of the record with the lowest rank of each group, by the number of the group."""
    order = np.lexsort((ranks, groups))
    return order[np.flatnonzero(np.append(True, np.diff(groups[order]) != 0))]


def _ordered(records: pa.Table) -> pa.Table:
    """The records by pair, training seed, cell and scenario seed."""
    keys = (records["seed"].to_numpy(), _places(records["cell"]), records["training_seed"].to_numpy())
    return records.take(pa.array(np.lexsort((*keys, _places(records["pair"])))))


def _places(column: pa.ChunkedArray) -> NDArray[np.int64]:
    """The place of each text of a column among its texts in their order."""
    whole = column.combine_chunks()
    texts = np.array(whole.dictionary.to_pylist(), dtype=object)
    places = np.empty(len(texts), np.int64)
    places[np.argsort(texts, kind="stable")] = np.arange(len(texts))
    return places[whole.indices.to_numpy()]


def times(records: pa.Table) -> NDArray[np.int64]:
    """When records were created, in microseconds, to find the newest; 0 for those from the future."""
    created = records["created_at"]
    return np.where(pc.greater(created, _latest()).to_numpy(), 0, created.cast(pa.int64()).to_numpy())


def _latest() -> datetime:
    """The latest time that is believed: now, and as much as clocks differ."""
    return datetime.now(UTC) + SKEW


_NOTHING = "there are no records in {out}; create some with `bench run out={out}`"
