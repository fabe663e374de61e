"""Episode records: an append-only Parquet data set with one file per finished unit of work and one row per episode.

Files are written atomically, so a killed run leaves only finished units (`bench.records.finished`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from bench import files
from bench.errors import UserError
from bench.plugins.track import Columns, Track
from bench.records import validity
from bench.records.schema import schema

FOLDER = "episodes"


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
