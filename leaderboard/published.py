"""Our own published records, shipped with the package.

    python -m cavbench.leaderboard.published RESULTS leaderboard/data/NAME.parquet
    python -m cavbench.leaderboard.published RESULTS leaderboard/data/NAME.parquet --add

The first publishes the newest records of a results folder, the second adds them to those of the file. A file holds one track.
"""

from __future__ import annotations

import argparse
from collections import Counter
from importlib.resources import as_file, files
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console

from cavbench.core.track import Track, tracks
from cavbench.errors import UserError
from cavbench.files import whole
from cavbench.records import reading
from cavbench.records.generations import check
from cavbench.records.schema import schema

SERIES = ("pair", "training_seed", "grid")
"""The columns that records are renewed by."""
MEASURED = frozenset({"return", "distance_m", "min_ttc_s", "mean_speed", "linf", "l2", "linf_m", "linf_mps"})
"""Columns of numbers that hardly repeat: they are stored byte by byte without a dictionary, a sixth smaller."""
TIMES = ("attack_ms", "crafting_s", "wall_s")
"""Columns of measured times. They are published with three significant digits: more are noise, and a twentieth of a file."""

SINGLE = ("linf", "l2", "linf_m", "linf_mps", "mean_speed")
"""Columns that are published in single precision, which makes a file a quarter smaller. No score is computed from them."""


def published(track: Track) -> pa.Table:
    """Every record of a track in `leaderboard/data/*.parquet`, an empty table if none is shipped."""
    with as_file(files("cavbench.leaderboard") / "data") as folder:
        paths = [path for path in sorted(folder.glob("*.parquet")) if check(path)[0].name == track.name]
        tables = [reading.upgraded(path) for path in paths]
    return pa.concat_tables([schema(track).empty_table(), *tables])


def every_track() -> dict[str, pa.Table]:
    """The published records of every track that has some."""
    found = {track.name: published(track) for track in tracks()}
    return {name: records for name, records in found.items() if records.num_rows}


def publish(folder: Path, file: Path, *, add: bool = False) -> int:
    """Write the newest records of a results folder as one file of published records.

    Args:
        folder: what `bench run out=` was given.
        file: where to write, usually in `leaderboard/data`.
        add: keep the file's records of all pairs, training seeds and grids of which the folder has fewer episodes.

    Returns:
        How many episodes the file has then.

    Raises:
        UserError: if the folder has records of no track, or of several, or of another one than the file.
    """
    found = reading.read_all(folder)
    if len(found) > 1:
        raise UserError(f"{folder} has records of the tracks {' and '.join(found)}; publish one track at a time")
    ((name, records),) = found.items()
    if add:
        if check(file)[0].name != name:
            raise UserError(f"{folder} has records of the track {name}, {file} has others")
        records = added(reading.upgraded(file), records)
    records = rounded(records)
    with whole(file) as made:
        apart = [name for name in records.column_names if name in MEASURED]
        others = [name for name in records.column_names if name not in MEASURED]
        pq.write_table(
            records,
            made,
            compression="zstd",
            compression_level=19,
            use_byte_stream_split=apart,
            use_dictionary=others,
        )
    return int(records.num_rows)


def rounded(records: pa.Table) -> pa.Table:
    """The records with as many digits as are published (`TIMES`, `SINGLE`)."""
    for place, field in enumerate(records.schema):
        if field.name in TIMES:
            times = [None if one is None else float(f"{one:.3g}") for one in records[place].to_pylist()]
            records = records.set_column(place, field, [times])
        elif field.name in SINGLE:
            records = records.set_column(place, field, records[place].cast(pa.float32(), safe=False).cast(field.type))
    return records


def added(old: pa.Table, new: pa.Table) -> pa.Table:
    """Both tables; of each pair, training seed and grid, the new records count where they are not fewer."""
    tables = [old, new.select(old.column_names).cast(old.schema)]
    keys = [list(zip(*(table[name].to_pylist() for name in SERIES), strict=True)) for table in tables]
    counts = [Counter(one) for one in keys]
    renewed = {key for key, count in counts[1].items() if count >= counts[0][key]}
    of_old = pa.array([key not in renewed for key in keys[0]], pa.bool_())
    of_new = pa.array([key in renewed for key in keys[1]], pa.bool_())
    return pa.concat_tables([tables[0].filter(of_old), tables[1].filter(of_new)])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Publish the newest records of a results folder.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("file", type=Path)
    parser.add_argument("--add", action="store_true", help="add them to the records of the file")
    words = parser.parse_args()
    Console().print(f"{publish(words.folder, words.file, add=words.add)} episodes in {words.file}")
