"""Tells from its columns which track a file of records is of."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from cavbench.core.track import Track, tracks
from cavbench.errors import UserError
from cavbench.records.schema import IDENTITY, PROVENANCE, schema

LONGEST_FOOTER = 2**26
"""Most bytes of the footer of a Parquet file, which names its columns and where they are."""


def track_of(path: Path, *, thoroughly: bool = False) -> Track:
    """The track of a file of records, from its columns.

    Args:
        path: the file.
        thoroughly: whether to read the whole file.

    Raises:
        UserError: if the file is missing, truncated, or not a file of records.
    """
    if path.exists() and not path.is_file():
        raise UserError(f"the record {path} is not a file; delete it and run again to recreate it")
    try:
        if _length(path) > LONGEST_FOOTER:
            raise pa.ArrowInvalid("footer")
        found = pq.read_table(path).schema if thoroughly else pq.read_schema(path)
    except (pa.ArrowException, OSError) as error:
        reason = "missing" if isinstance(error, FileNotFoundError) else "truncated or not Parquet"
        raise UserError(f"the record {path} is {reason}; delete it and run again to recreate it") from None
    for track in tracks():
        if found.equals(schema(track)):
            return track
    raise UserError(f"the record {path} has columns that this version does not write; use another folder with out=")


def glance(path: Path) -> Track:
    """As `track_of`, but only from the names in the footer, ten times as fast; falls back to `track_of`."""
    footer = _footer(path)
    for track in tracks():
        if all(name in footer for name in _encoded(schema(track))) and _elements(footer) == _wanted(schema(track)):
            return track
    return track_of(path)


@cache
def _encoded(columns: pa.Schema) -> tuple[bytes, ...]:
    """The names of the columns, those that only some tracks have first: a file of another track is told at the first of them."""
    common = {field.name for field in (*IDENTITY, *PROVENANCE)}
    return tuple(name.encode() for name in sorted(columns.names, key=common.__contains__))


def _wanted(columns: pa.Schema) -> int:
    """How many elements the schema in a footer has: the root, one for each column, and two more for a list."""
    return 1 + sum(3 if pa.types.is_list(column.type) else 1 for column in columns)


def _elements(footer: bytes) -> int:
    """How many elements the schema in a footer has; 0 where it is not written as Parquet's compact Thrift always is.

    The footer begins with the version (field 1, a varint) and the header of the list of elements (field 2).
    """
    place = 1
    while place < len(footer) and footer[place] & 0x80:
        place += 1
    # Type and number of the two fields; the list's header has its length, or says that it follows.
    if footer[:1] != b"\x15" or footer[place + 1 : place + 2] != b"\x19" or len(footer) < place + 5:
        return 0
    header = footer[place + 2]
    if header >> 4 < 15:
        return header >> 4
    low, high = footer[place + 3], footer[place + 4]
    return low if low < 0x80 else (low & 0x7F) | high << 7


def _footer(path: Path) -> bytes:
    """The footer of a Parquet file, which names its columns; empty if it cannot be read."""
    try:
        if not path.is_file() or (size := _length(path)) > LONGEST_FOOTER:
            return b""
        with path.open("rb") as file:
            file.seek(-8 - size, os.SEEK_END)
            return file.read(size)
    except OSError:
        return b""


def _length(path: Path) -> int:
    """The length of a Parquet file's footer, as the file states it."""
    with path.open("rb") as file:
        file.seek(-8, os.SEEK_END)
        return int.from_bytes(file.read(4), "little")
