"""Finds out which units of a run are finished, from the rows of their records, and sets wrong records aside."""

from __future__ import annotations

import itertools
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cavbench.core.track import Track
from cavbench.errors import UserError, notice
from cavbench.records import validity
from cavbench.records.columns import track_of
from cavbench.records.packing import packed_files
from cavbench.records.schema import schema
from cavbench.records.store import path_of, write_packed
from cavbench.scenarios import Cell

SET_ASIDE = "set_aside"
WHOSE = ("pair", "training_seed", "cell")
"""Columns that say whose records they are."""


class _Pair(Protocol):
    @property
    def id(self) -> str: ...


class Wanted(Protocol):
    """A unit of work, as far as its records must show it (`cavbench.run.unit.Unit`)."""

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

    A file under the name of a unit that is anything else is moved to `OUT/set_aside`, with a notice, so that the unit is driven
    again. So is a file of many units with such a unit; its other units are kept in a new file.

    Args:
        out: results folder.
        units: the units by their fingerprints.

    Raises:
        UserError: if a file cannot be moved or written.
    """
    there = {path.stem for path in path_of(out, "").parent.glob("[!.]*.parquet")}
    done = set()
    for key in units.keys() & there:
        path = path_of(out, key)
        why = _incomplete(path, key, units[key])
        # Another run may have packed it just now: then it is in a packed file, which is looked at next.
        if not path.exists():
            continue
        if why:
            notice(
                f"the record {path} does not count as finished: {why}; its unit is driven again, it is {_aside(out, path)}"
            )
        else:
            done.add(key)
    left = {key: unit for key, unit in units.items() if key not in done}
    for path in packed_files(out):
        if not left:
            break
        # No copy of what is left: it may be a hundred thousand units, and there may be hundreds of files.
        for key in _packed(out, path, left):
            done.add(key)
            del left[key]
    return done


def _incomplete(path: Path, key: str, unit: Wanted) -> str:
    """Why a file does not hold the records of a unit; empty if it does."""
    try:
        found = track_of(path)
        if found.name != unit.track.name:
            return f"it is of the {found.name} track"
        # From its footer: a file may state more rows than fit into the memory.
        if (rows := pq.read_metadata(path).num_rows) != len(unit.seeds):
            return f"it has {rows} rows, the unit has {len(unit.seeds)} episodes"
        records = pq.read_table(path)
    except UserError as error:
        return "it " + str(error).removeprefix(f"the record {path} ").partition(";")[0]
    # Its footer says what it should hold.
    except (pa.ArrowException, OSError):
        return "it is truncated or not Parquet"
    if set(records["unit"].to_pylist()) != {key}:
        return "it has the rows of another unit"
    other = _other_rows(records["seed"].to_numpy(), unit)
    whose = [set(records[name].to_pylist()) for name in WHOSE]
    return other or _invalid(records, unit.track) or _of_another(whose, unit)


def _of_another(whose: Sequence[Collection[Any]], unit: Wanted) -> str:
    """Which columns of a unit's valid records are not its own; empty if none.

    Args:
        whose: the values in its rows of each column of `WHOSE`.
        unit: the unit.
    """
    pairs, training_seeds, cells = whose
    if any(pair != unit.pair.id for pair in pairs):
        return "it has the rows of another pair"
    if any(seed != unit.training_seed for seed in training_seeds):
        return "it has the rows of another training seed"
    if any(_parsed(cell) != dict(unit.cell) for cell in cells):
        return "it has the rows of another cell"
    return ""


@lru_cache(maxsize=1024)
def _parsed(cell: str) -> Any:
    return json.loads(cell)


def _other_rows(seeds: np.ndarray, unit: Wanted) -> str:
    """Why rows with these scenario seeds are not those of a unit; empty if they are."""
    if len(seeds) != len(unit.seeds):
        return f"it has {len(seeds)} rows, the unit has {len(unit.seeds)} episodes"
    return "" if np.array_equal(np.sort(seeds), np.asarray(unit.seeds)) else "it has other scenarios"


def _invalid(records: pa.Table, track: Track) -> str:
    problem = validity.complaint(records, track)
    return problem[1] if problem else ""


def _packed(out: Path, path: Path, units: Mapping[str, Wanted]) -> set[str]:
    """The fingerprints among `units` that have records in a file of many units."""
    try:
        inside = pc.unique(pq.read_table(path, columns=["unit"])["unit"]).to_pylist()
        wanted = {key for key in inside if key in units}
        if not wanted:
            return set()
        track = track_of(path)
        text = [column.name for column in schema(track) if pa.types.is_string(column.type)]
        records = pq.read_table(path, read_dictionary=text)
    except (pa.ArrowException, OSError, UserError):
        if path.exists():
            notice(
                f"the record {path} is truncated or not Parquet; its units are driven again, it is {_aside(out, path)}"
            )
        return set()
    wrong = _wrong(records, track, {key: units[key] for key in wanted})
    for key, why in wrong.items():
        notice(f"unit {key} in the record {path} does not count as finished: {why}; it is driven again")
    if wrong:
        _without(out, path, wrong.keys())
    return wanted - wrong.keys()


def _wrong(records: pa.Table, track: Track, units: Mapping[str, Wanted]) -> dict[str, str]:
    """The units whose rows are not theirs or are invalid, with the reason.

    Args:
        records: of these and other units, text as dictionaries.
        track: of the records.
        units: the units by their fingerprints.
    """
    encoded = records["unit"].combine_chunks()
    codes, names = encoded.indices.to_numpy(), encoded.dictionary.to_pylist()
    order = np.argsort(codes, kind="stable")
    starts = np.append(0, np.flatnonzero(np.diff(codes[order])) + 1)
    parts = np.split(order, starts[1:])
    seeds = records["seed"].to_numpy()
    found = {}
    for rows in parts:
        key = names[codes[rows[0]]]
        if key in units:
            other = units[key].track.name != track.name
            why = f"it is of the {track.name} track" if other else _other_rows(seeds[rows], units[key])
            if why:
                found[key] = why
    suspect = validity.complaint(records, track)
    whose = zip(*(_ends(records[name], order, starts) for name in WHOSE), strict=True)
    for rows, own in zip(parts, whose, strict=True):
        key = names[codes[rows[0]]]
        if key in units and key not in found:
            invalid = _invalid(records.take(pa.array(rows)), track) if suspect else ""
            if why := invalid or _of_another(own, units[key]):
                found[key] = why
    return found


def _ends(column: pa.ChunkedArray, order: NDArray[np.int64], starts: NDArray[np.int64]) -> Iterator[tuple[Any, Any]]:
    """Two values of a column in each part of its rows, which differ unless the part has one value only.

    Args:
        column: the column.
        order: its rows, part after part.
        starts: where each part begins in `order`.
    """
    whole = column.combine_chunks()
    encoded = whole if pa.types.is_dictionary(whole.type) else whole.dictionary_encode()
    codes, values = encoded.indices.to_numpy()[order], encoded.dictionary.to_pylist()
    for low, high in zip(np.minimum.reduceat(codes, starts), np.maximum.reduceat(codes, starts), strict=True):
        yield values[low], values[high]


def _without(out: Path, path: Path, units: Collection[str]) -> None:
    """Write a file of many units again without some of them, and move the old one aside."""
    records = pq.read_table(path)
    rest = records.filter(pc.invert(pc.is_in(records["unit"], pa.array(list(units)))))
    if rest.num_rows:
        # Before the old file is moved: a run that is killed in between leaves both.
        write_packed(out, [rest.filter(pc.equal(rest["unit"], key)) for key in pc.unique(rest["unit"])])
    notice(f"the record {path} is {_aside(out, path)}; its other units are kept in a new file")


def _aside(out: Path, path: Path) -> str:
    """Move a file to `OUT/set_aside`, under a name that is free, and say where it is."""
    folder = out / SET_ASIDE
    try:
        folder.mkdir(exist_ok=True)
        names = (folder / f"{path.stem}{f'-{number}' if number else ''}.parquet" for number in itertools.count())
        free = next(name for name in names if not name.exists())
        path.rename(free)
    except FileNotFoundError:
        return "moved by another run"
    except OSError as error:
        raise UserError(f"the record {path} is not complete, and cannot be moved: {error.strerror or error}") from error
    return f"kept as {free}"
