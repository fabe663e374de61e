"""Tells from its columns which track a file of records is of."""

from __future__ import annotations

import os
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from cavbench.core.track import Track, tracks
from cavbench.errors import UserError
from cavbench.records.schema import written_by

LONGEST_FOOTER = 2**26
"""Most bytes of the footer of a Parquet file, which names its columns and where they are."""


def track_of(path: Path) -> Track:
    """The track of a file of records, from its columns.

    Args:
        path: the file.

    Raises:
        UserError: if the file is missing, truncated, or not a file of records.
    """
    if path.exists() and not path.is_file():
        raise UserError(f"the record {path} is not a file; delete it and run again to recreate it")
    try:
        if _length(path) > LONGEST_FOOTER:
            raise pa.ArrowInvalid("footer")
        found = pq.read_schema(path)
    # The name of a column may be no text.
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = "missing" if isinstance(error, FileNotFoundError) else "truncated or not Parquet"
        raise UserError(f"the record {path} is {reason}; delete it and run again to recreate it") from None
    for track in tracks():
        if written_by(track, found):
            return track
    raise UserError(f"the record {path} has columns that this version does not write; use another folder with out=")


def _length(path: Path) -> int:
    """The length of a Parquet file's footer, as the file states it."""
    with path.open("rb") as file:
        file.seek(-8, os.SEEK_END)
        return int.from_bytes(file.read(4), "little")
