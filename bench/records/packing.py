"""Packs the records of many units into one file, so that a results folder of 100,000 units stays quick to read.

A packed file is synced to the disk before the files are deleted whose rows it has. A process that is killed in between leaves
units in two files; reading counts them once. A packing neither changes nor deletes packed files, so two runs that pack the same
folder at the same time lose nothing.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from cavbench.core.track import Track, tracks
from cavbench.records.schema import schema
from cavbench.records.store import FOLDER, MANY, path_of, write, write_packed

UNITS = 256
"""Units in a packed file, and fewest files that are packed."""


def packed_files(out: Path) -> list[Path]:
    """The files of many units in a results folder."""
    return sorted(path for path in (out / FOLDER).glob(f"{MANY}*.parquet") if path.is_file())


def pack(out: Path) -> None:
    """Pack the files of single units in a results folder, `UNITS` to a file; fewer are left as they are.

    Files that hold anything else than the unit of their name are left, too.

    Raises:
        UserError: if a packed file cannot be written.
    """
    there = sorted((out / FOLDER).glob("[!.]*.parquet"))
    single = [path for path in there if not path.name.startswith(MANY) and path.is_file()]
    if len(single) < UNITS:
        return
    with _alone(out) as alone:
        waiting: dict[Track, list[tuple[Path, pa.Table]]] = {}
        for path in single if alone else ():
            if (found := _single(path)) is None:
                continue
            track, records = found
            some = waiting.setdefault(track, [])
            some.append((path, records))
            if len(some) == UNITS:
                _replace(out, waiting.pop(track))


def units_in(path: Path) -> set[str]:
    """The fingerprints of the units in a file of records; empty if it was deleted, or is no file."""
    if not path.is_file():
        return set()
    try:
        column = pq.read_table(path, columns=["unit"], read_dictionary=["unit"])["unit"]
    except FileNotFoundError:
        return set()
    return {name for chunk in column.chunks for name in chunk.dictionary.to_pylist()}


def copy(results: Path, units: Collection[str], out: Path) -> None:
    """Copy the records of some units to another results folder, a file for each.

    Raises:
        OSError: if a file cannot be read or written.
    """
    wanted = set(units)
    for unit in units:
        with suppress(FileNotFoundError):
            path_of(out, unit).write_bytes(path_of(results, unit).read_bytes())
            wanted.remove(unit)
    for path in packed_files(results) if wanted else ():
        if here := wanted & units_in(path):
            records = pq.read_table(path)
            for unit in here:
                write(out, records.filter(pc.equal(records["unit"], unit)))
            wanted -= here


def _single(path: Path) -> tuple[Track, pa.Table] | None:
    """The track and the records of a file that holds the unit of its name; None if it is anything else."""
    try:
        records = pq.ParquetFile(path).read(use_threads=False)
    except (pa.ArrowException, OSError):
        return None
    track = next((track for track in tracks() if records.schema.equals(schema(track))), None)
    if track is None or pc.unique(records["unit"]).to_pylist() != [path.stem]:
        return None
    return track, records


def _replace(out: Path, some: list[tuple[Path, pa.Table]]) -> None:
    """Write a packed file, and delete the files that it replaces."""
    write_packed(out, [records for _, records in some])
    # Otherwise a power failure could undo the new name, and keep the deletions.
    with suppress(OSError):
        folder = os.open(out / FOLDER, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    for path, _ in some:
        path.unlink(missing_ok=True)


@contextmanager
def _alone(out: Path) -> Iterator[bool]:
    """Whether no other process packs this folder now: two would do the same work. Without locks, everyone packs."""
    try:
        import fcntl
    except ImportError:
        yield True
        return
    with (out / FOLDER / ".packing").open("wb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        except OSError:
            pass
        yield True
