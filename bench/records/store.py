"""Episode records: a Parquet data set with one row per episode; a unit of work is in a file of its own, or in one of many units.

Files are written atomically, so a killed run leaves only finished units. Whether a unit is finished is read from its rows
(`cavbench.records.finished`).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from cavbench import files
from cavbench.core.track import Columns, Track, tracks
from cavbench.errors import UserError
from cavbench.records import validity
from cavbench.records.schema import schema
from cavbench.records.table import plain

FOLDER, MANY = "episodes", "packed-"
"""The folder of the records, and the beginning of the names of files with many units."""
LATER = ("recordings", "set_aside", "stops", "verifying")
"""Folders that a run or a check makes when it needs them."""
TOGETHER = 16
"""So many units that are finished at once are written to one file: a file of its own for each takes ten times as long."""


def prepare(out: Path) -> None:
    """Create the results folder and check that all of it is writable, before any work is done.

    Raises:
        UserError: if the folder cannot be written, or a file has the name of a folder in it.
    """
    files.check_folder(out, "the results folder")
    files.check_folder(out / FOLDER, "the results folder")
    later = [out / name for name in (*LATER, *(track.artefact[1] for track in tracks() if track.artefact))]
    for path in (*later, *(out / "recordings").glob("*")):
        if os.path.lexists(path):
            files.check_folder(path, "the results folder")


def path_of(out: Path, unit: str) -> Path:
    """The file of a unit's records, by its fingerprint; there is none if the unit is in a file of many."""
    return out / FOLDER / f"{unit}.parquet"


def write(out: Path, records: pa.Table) -> Path:
    """Write the records of one unit atomically, and return the file.

    Raises:
        UserError: if it cannot be written.
    """
    return _written(path_of(out, records["unit"][0].as_py()), records)


def write_all(out: Path, units: Sequence[pa.Table]) -> None:
    """Write the records of several units of a track: a file for each, or one file for `TOGETHER` and more.

    Raises:
        UserError: if a file cannot be written.
    """
    if len(units) >= TOGETHER:
        write_packed(out, units)
        return
    for records in units:
        write(out, records)


def write_packed(out: Path, units: Sequence[pa.Table]) -> Path:
    """Write the records of many units of a track to one file atomically. Its name depends on nothing but the units.

    Raises:
        UserError: if it cannot be written.
    """
    names = sorted(records["unit"][0].as_py() for records in units)
    name = hashlib.sha256("\n".join(names).encode()).hexdigest()
    return _written(out / FOLDER / f"{MANY}{name}.parquet", pa.concat_tables(units))


def _written(path: Path, records: pa.Table) -> Path:
    try:
        with files.whole(path) as file:
            pq.write_table(plain(records), file, compression="zstd")
    except OSError as error:
        raise UserError(f"the record {path} cannot be written: {error.strerror}") from error
    return path


def table(constants: Mapping[str, object], measured: Columns, *, track: Track) -> pa.Table:
    """The records of a unit, one row per episode.

    Args:
        constants: values that all rows share (`cavbench.run.unit.Unit.constants`).
        measured: one column for each measurement, and `seed`: [B], or [B, n] for lists.
        track: track of the records.

    Raises:
        ValueError: if a component measured a value that cannot be; the message names the column and the scenario seed.
    """
    rows = len(measured["seed"])
    columns = []
    for column in schema(track):
        values = [constants[column.name]] * rows if column.name in constants else measured[column.name].tolist()
        columns.append(pa.array(values, column.type, from_pandas=column.nullable))
    made = pa.Table.from_arrays(columns, schema=schema(track))
    if problem := validity.complaint(made, track):
        row, why = problem
        raise ValueError(f"{why} in scenario seed {made['seed'][row]}")
    return made
