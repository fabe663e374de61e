"""Identifies the track and the format version of a file of records, and reads older versions.

Version 1 had one column each for lanes, density and weather, and no facts of the world; its first files had no probes either.
Probes are added at the end: files that have only the first of them can be read.
"""

from __future__ import annotations

import json
import os
from functools import cache
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from cavbench.core.track import Track, tracks
from cavbench.errors import UserError
from cavbench.records.schema import FLOAT, IDENTITY, INT, PROVENANCE, TEXT, field, schema

AXES_OF_V1 = (
    field("lanes", pa.int32(), "of the cell"),
    field("density", FLOAT, "of the cell"),
    field("weather", TEXT, "of the cell"),
)
CELL_OF_V1 = "to_json({'lanes': lanes, 'density': density, 'weather': weather})::varchar"

LONGEST_FOOTER = 2**26
"""Most bytes of the footer of a Parquet file, which names its columns and where they are."""
SQL = {FLOAT: "double", INT: "bigint", TEXT: "varchar", pa.bool_(): "boolean"}
"""The types of probes in SQL."""
ADDED = {"threat_share": "1.0::double"}
"""Identity columns that records of version 2 got later, with the value of records without them."""


@cache
def generations(track: Track) -> tuple[pa.Schema, ...]:
    """The schemas of a track's records, the current one first."""
    today = schema(track)
    # A newer file also holds the names of an older format, so the newest comes first.
    versions = [today, pa.schema([column for column in today if column.name not in ADDED], today.metadata)]
    if track.facts_of_v1:
        whole = versions[-1]
        place = whole.get_field_index("cell")
        versions.append(pa.schema([*list(whole)[:place], *AXES_OF_V1, *list(whole)[place + 2 :]]))
    counts = range(len(track.probes) + 1)
    return tuple(pa.schema(list(one)[: len(one) - count], one.metadata) for one in versions for count in counts)


def selection(track: Track, columns: pa.Schema) -> str:
    """The SQL select list that converts files of a generation to the current schema."""
    present = set(columns.names)
    facts = json.dumps(track.facts_of_v1, separators=(",", ":")).replace("'", "''")
    older = {"cell": f'{CELL_OF_V1} as "cell"', "world_facts": f"'{facts}' as \"world_facts\""}
    missing = {field.name: f'null::{SQL[field.type]} as "{field.name}"' for field in track.probes} | older
    missing |= {name: f'"{stand_in}" as "{name}"' for name, stand_in in track.of_older.items()}
    missing |= {name: f'{value} as "{name}"' for name, value in ADDED.items()}
    return ", ".join(f'"{name}"' if name in present else missing[name] for name in schema(track).names)


def check(path: Path, *, thoroughly: bool = False) -> tuple[Track, pa.Schema]:
    """The track and the generation of a file of records, from its columns.

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
        for generation in generations(track):
            if found.equals(generation):
                return track, generation
    raise UserError(f"the record {path} has columns that this version does not write; use another folder with out=")


def glance(path: Path) -> tuple[Track, pa.Schema]:
    """As `check`, but only from the names in the footer, ten times as fast; falls back to `check`."""
    footer = _footer(path)
    for track in tracks():
        for generation in generations(track):
            if all(name in footer for name in _encoded(generation)) and _elements(footer) == _wanted(generation):
                return track, generation
    return check(path)


@cache
def _encoded(generation: pa.Schema) -> tuple[bytes, ...]:
    """The names of the columns, those that only some tracks have first: a file of another track is told at the first of them."""
    common = {field.name for field in (*IDENTITY, *PROVENANCE)}
    return tuple(name.encode() for name in sorted(generation.names, key=common.__contains__))


def _wanted(generation: pa.Schema) -> int:
    """How many elements the schema in a footer has: the root, one for each column, and two more for a list."""
    return 1 + sum(3 if pa.types.is_list(column.type) else 1 for column in generation)


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
