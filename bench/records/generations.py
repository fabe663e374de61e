"""Which track and which version of the format a file of records is of, and how older ones are read.

Version 1 had a column each for lanes, density and weather, and said nothing of its world; its first files had no probes either.
"""

from __future__ import annotations

import json
import os
from functools import cache
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from bench.errors import UserError
from bench.plugins.track import Track, tracks
from bench.records.schema import FLOAT, IDENTITY, PROVENANCE, TEXT, field, schema

AXES_OF_V1 = (
    field("lanes", pa.int32(), "of the cell"),
    field("density", FLOAT, "of the cell"),
    field("weather", TEXT, "of the cell"),
)
CELL_OF_V1 = "to_json({'lanes': lanes, 'density': density, 'weather': weather})::varchar"


@cache
def generations(track: Track) -> tuple[pa.Schema, ...]:
    """The columns of a track's records, those of today first."""
    today = schema(track)
    if not track.facts_of_v1:
        return (today,)
    place = today.get_field_index("cell")
    first = pa.schema([*list(today)[:place], *AXES_OF_V1, *list(today)[place + 2 :]])
    return today, first, pa.schema(list(first)[: len(first) - len(track.probes)])


def selection(track: Track, columns: pa.Schema) -> str:
    """What to select, as SQL, from files of a generation to have the columns of today."""
    there = set(columns.names)
    facts = json.dumps(track.facts_of_v1, separators=(",", ":")).replace("'", "''")
    older = {"cell": f'{CELL_OF_V1} as "cell"', "world_facts": f"'{facts}' as \"world_facts\""}
    missing = {name: f'null::double as "{name}"' for name in (field.name for field in track.probes)} | older
    return ", ".join(f'"{name}"' if name in there else missing[name] for name in schema(track).names)


def check(path: Path, *, thoroughly: bool = False) -> tuple[Track, pa.Schema]:
    """The track and the generation of a file of records, by its columns, or by reading it all.

    Raises:
        UserError: if it is truncated or foreign.
    """
    try:
        found = pq.read_table(path).schema if thoroughly else pq.read_schema(path)
    except (pa.ArrowException, OSError) as error:
        reason = "not there" if isinstance(error, FileNotFoundError) else "truncated or not Parquet"
        raise UserError(f"the record {path} is {reason}; delete it and run again to make it anew") from None
    for track in tracks():
        for generation in generations(track):
            if found.equals(generation):
                return track, generation
    raise UserError(f"the record {path} has other columns than this version writes; use another folder with out=")


def glance(path: Path) -> tuple[Track, pa.Schema]:
    """The same by the names in the footer alone, ten times as fast; a file that seems foreign is looked at in full."""
    footer = _footer(path)
    for track in tracks():
        for generation in generations(track):
            if all(name in footer for name in _encoded(generation)):
                return track, generation
    return check(path)


@cache
def _encoded(generation: pa.Schema) -> tuple[bytes, ...]:
    """The names of the columns, those that only some tracks have first: a file of another track is told at the first of them."""
    common = {field.name for field in (*IDENTITY, *PROVENANCE)}
    return tuple(name.encode() for name in sorted(generation.names, key=common.__contains__))


def _footer(path: Path) -> bytes:
    """The end of a Parquet file, where its columns are named."""
    try:
        with path.open("rb") as file:
            file.seek(-8, os.SEEK_END)
            size = int.from_bytes(file.read(4), "little")
            file.seek(-8 - size, os.SEEK_END)
            return file.read(size)
    except OSError:
        return b""
