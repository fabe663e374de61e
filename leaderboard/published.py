"""Our own published records, shipped with the package.

    python -m leaderboard.published RESULTS leaderboard/data/NAME.parquet

publishes the newest records of a results folder; a file holds one track.
"""

from __future__ import annotations

import argparse
from importlib.resources import as_file, files
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console

from bench.errors import UserError
from bench.files import whole
from bench.plugins.track import Track, tracks
from bench.records import reading
from bench.records.generations import check
from bench.records.schema import schema


def published(track: Track) -> pa.Table:
    """Every record of a track in `leaderboard/data/*.parquet`, an empty table if none is shipped."""
    with as_file(files("leaderboard") / "data") as folder:
        paths = [path for path in sorted(folder.glob("*.parquet")) if check(path)[0].name == track.name]
        tables = [reading.upgraded(path) for path in paths]
    return pa.concat_tables([schema(track).empty_table(), *tables])


def every_track() -> dict[str, pa.Table]:
    """The published records of every track that has some."""
    found = {track.name: published(track) for track in tracks()}
    return {name: records for name, records in found.items() if records.num_rows}


def publish(folder: Path, file: Path) -> int:
    """Write the newest records of a results folder as one file of published records.

    Args:
        folder: what `bench run out=` was given.
        file: where to write, usually in `leaderboard/data`.

    Returns:
        How many episodes that are.

    Raises:
        UserError: if the folder has records of no track, or of several.
    """
    found = reading.read_all(folder)
    if len(found) > 1:
        raise UserError(f"{folder} has records of the tracks {' and '.join(found)}; publish one track at a time")
    (records,) = found.values()
    with whole(file) as made:
        pq.write_table(records, made, compression="zstd", compression_level=19)
    return int(records.num_rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Publish the newest records of a results folder.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("file", type=Path)
    words = parser.parse_args()
    Console().print(f"{publish(words.folder, words.file)} episodes in {words.file}")
