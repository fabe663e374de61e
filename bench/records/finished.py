"""Says which units are finished: their files hold what these units measure, whatever else may lie under their names."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import pyarrow as pa
import pyarrow.parquet as pq

from bench.errors import UserError, notice
from bench.plugins.track import Track
from bench.records import validity
from bench.records.generations import check
from bench.records.reading import upgraded
from bench.records.schema import schema
from bench.records.store import path_of
from bench.scenarios import Cell

SET_ASIDE = "set_aside"


class _Pair(Protocol):
    @property
    def id(self) -> str: ...


class Wanted(Protocol):
    """A unit of work, as far as its records must show it (`bench.run.unit.Unit`)."""

    @property
    def pair(self) -> _Pair:
        """What drives."""

    @property
    def cell(self) -> Cell:
        """The traffic it drives in."""

    @property
    def training_seed(self) -> int:
        """The seed of its networks."""

    @property
    def seeds(self) -> range:
        """The scenario seed of each episode."""

    @property
    def track(self) -> Track:
        """The track of its records."""


def finished(out: Path, units: Mapping[str, Wanted]) -> set[str]:
    """The fingerprints among `units` that have records: of this unit, one row for each of its seeds, with possible values.

    Whatever else has the name of a unit's file is moved to `OUT/set_aside`, with a notice, so that the unit is driven again.

    Args:
        out: results folder.
        units: the units by their fingerprints.

    Raises:
        UserError: if a file cannot be moved.
    """
    done = set()
    for key, unit in units.items():
        path = path_of(out, key)
        if not (path.exists() or path.is_symlink()):
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
        found, generation = check(path)
        if found.name != unit.track.name:
            return f"it is of the {found.name} track"
        # From its footer: a file may state more rows than fit into the memory.
        if (rows := pq.read_metadata(path).num_rows) != len(unit.seeds):
            return f"it has {rows} rows, the unit has {len(unit.seeds)} episodes"
        records = pq.read_table(path) if generation.equals(schema(found)) else upgraded(path)
    except UserError as error:
        return "it " + str(error).removeprefix(f"the record {path} ").partition(";")[0]
    # Its footer says what it should hold.
    except (pa.ArrowException, OSError):
        return "it is truncated or not Parquet"
    if set(records["unit"].to_pylist()) != {key}:
        return "it has the rows of another unit"
    if sorted(records["seed"].to_pylist()) != list(unit.seeds):
        return "it has other scenarios"
    if problem := validity.complaint(records, unit.track):
        return problem[1]
    return _of_another(records, unit)


def _of_another(records: pa.Table, unit: Wanted) -> str:
    """Which of its columns are not the unit's; empty if none."""
    if set(records["pair"].to_pylist()) != {unit.pair.id}:
        return "it has the rows of another pair"
    if set(records["training_seed"].to_pylist()) != {unit.training_seed}:
        return "it has the rows of another training seed"
    if any(json.loads(cell) != dict(unit.cell) for cell in set(records["cell"].to_pylist())):
        return "it has the rows of another cell"
    return ""


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
