"""Episode records: an append-only Parquet data set with one file per finished unit of work and one row per episode.

Files are written atomically, so a killed run leaves only finished units. Whether a unit is finished is read from its rows.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import pyarrow as pa
import pyarrow.parquet as pq

from bench import files
from bench.errors import UserError, notice
from bench.plugins.track import Columns, Track
from bench.records import validity
from bench.records.generations import check
from bench.records.schema import schema

FOLDER, SET_ASIDE = "episodes", "set_aside"


def prepare(out: Path) -> None:
    """Create the results folder and check that it is writable, before any work is done.

    Raises:
        UserError: if the folder cannot be written.
    """
    files.check_folder(out, "the results folder")
    files.check_folder(out / FOLDER, "the results folder")


def path_of(out: Path, unit: str) -> Path:
    """The file of a unit's records, by its fingerprint."""
    return out / FOLDER / f"{unit}.parquet"


class Wanted(Protocol):
    """A unit of work, as far as its records must show it (`bench.run.unit.Unit`)."""

    @property
    def seeds(self) -> range:
        """The scenario seed of each episode."""

    @property
    def track(self) -> Track:
        """The track of its records."""


def finished(out: Path, units: Mapping[str, Wanted]) -> set[str]:
    """The fingerprints among `units` that have records: of this unit, one row for each of its seeds, with possible values.

    A file under the name of a unit that is anything else is moved to `OUT/set_aside`, with a notice, so that the unit is driven
    again.

    Args:
        out: results folder.
        units: the units by their fingerprints.

    Raises:
        UserError: if a file cannot be moved.
    """
    done = set()
    for key, unit in units.items():
        path = path_of(out, key)
        if not path.exists():
            continue
        if why := _incomplete(path, key, unit):
            notice(
                f"the record {path} does not count as finished: {why}; its unit is driven again, it is {_aside(out, path)}"
            )
        else:
            done.add(key)
    return done


def _incomplete(path: Path, key: str, unit: Wanted) -> str:
    """Why a file does not hold the records of a unit; empty if it does."""
    try:
        found, generation = check(path, thoroughly=True)
        records = pq.read_table(path)
    except UserError as error:
        return "it " + str(error).removeprefix(f"the record {path} ").partition(";")[0]
    if found.name != unit.track.name:
        return f"it is of the {found.name} track"
    if records.num_rows != len(unit.seeds):
        return f"it has {records.num_rows} rows, the unit has {len(unit.seeds)} episodes"
    if set(records["unit"].to_pylist()) != {key}:
        return "it has the rows of another unit"
    if sorted(records["seed"].to_pylist()) != list(unit.seeds):
        return "it has other scenarios"
    problem = validity.complaint(records, unit.track) if generation.equals(schema(unit.track)) else None
    return problem[1] if problem else ""


def _aside(out: Path, path: Path) -> str:
    """Move a file to `OUT/set_aside`, under a name that is free, and say where it is."""
    folder = out / SET_ASIDE
    try:
        folder.mkdir(exist_ok=True)
        names = (folder / f"{path.stem}{f'-{number}' if number else ''}.parquet" for number in itertools.count())
        free = next(name for name in names if not name.exists())
        path.rename(free)
    except OSError as error:
        raise UserError(f"the record {path} is not complete, and cannot be moved: {error.strerror or error}") from error
    return f"kept as {free}"


def write(out: Path, records: pa.Table) -> Path:
    """Write the records of one unit atomically, and return the file.

    Raises:
        UserError: if it cannot be written.
    """
    path = path_of(out, records["unit"][0].as_py())
    try:
        with files.whole(path) as file:
            pq.write_table(records, file, compression="zstd")
    except OSError as error:
        raise UserError(f"the record {path} cannot be written: {error.strerror}") from error
    return path


def table(constants: Mapping[str, object], measured: Columns, *, track: Track) -> pa.Table:
    """The records of a unit, one row per episode.

    Args:
        constants: values that all rows share (`bench.run.unit.Unit.constants`).
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
