"""Tells from its columns which track a file of records is of."""

from __future__ import annotations

import os
import re
from collections import UserDict
from io import BytesIO
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from cavbench.core.track import Track, tracks
from cavbench.errors import UserError
from cavbench.records.schema import schema

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
    """As `track_of`, but of many files alike only the first is looked at: the footers of the others have the same columns."""
    footer = _footer(path)
    for (begin, schema_of_arrow), track in _SEEN.items():
        if footer.startswith(begin) and schema_of_arrow in footer and track in tracks():
            return track
    found = track_of(path)
    _SEEN[_columns(schema(found))] = found
    return found


# Records are read during a run, too, so this is not among the data that no unit may change (`framework.Snapshot`).
_SEEN: UserDict[tuple[bytes, bytes], Track] = UserDict()


def _columns(wanted: pa.Schema) -> tuple[bytes, bytes]:
    """The columns in the footer of a file, as it is written here: for any reader, and for Arrow.

    A footer begins with the names, types and order of all columns; the number of rows follows. So this is what the footers of a
    file with one row and of one with two have in common at their beginning.
    """
    one, two = (_footer_of(wanted, rows) for rows in (1, 2))
    begin = one[: next(place for place, (left, right) in enumerate(zip(one, two, strict=False)) if left != right)]
    found = re.search(rb"ARROW:schema.*?([A-Za-z0-9+/=]{100,})", one, re.DOTALL)
    return begin, found[1] if found else b""


def _footer_of(wanted: pa.Schema, rows: int) -> bytes:
    """The footer of a file with so many rows of zeros."""
    columns = [
        pa.array([[] if pa.types.is_list(column.type) else ""] * rows, column.type)
        if pa.types.is_list(column.type) or pa.types.is_string(column.type)
        else pa.array([0] * rows).cast(column.type)
        for column in wanted
    ]
    file = BytesIO()
    pq.write_table(pa.table(columns, schema=wanted), file)
    content = file.getvalue()
    return content[-8 - int.from_bytes(content[-8:-4], "little") : -8]


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
