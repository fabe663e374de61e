"""Our own published records, shipped with the package.

    python -m leaderboard.published RESULTS leaderboard/data/NAME.parquet

publishes the newest records of a results folder.
"""

from __future__ import annotations

import argparse
from importlib.resources import as_file, files
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console

from bench import results
from bench.files import whole
from bench.results import SCHEMA


def published() -> pa.Table:
    """Every record in `leaderboard/data/*.parquet`, an empty table if none is shipped."""
    tables = []
    with as_file(files("leaderboard") / "data") as folder:
        for path in sorted(folder.glob("*.parquet")):
            table = pq.read_table(path)
            tables.append(table.select(SCHEMA.names).cast(SCHEMA))
    return pa.concat_tables(tables) if tables else SCHEMA.empty_table()


def publish(folder: Path, file: Path) -> int:
    """Write the newest records of a results folder as one file of published records.

    Args:
        folder: what `bench run out=` was given.
        file: where to write, usually in `leaderboard/data`.

    Returns:
        How many episodes that are.
    """
    records = results.read(folder)
    with whole(file) as made:
        pq.write_table(records, made, compression="zstd", compression_level=19)
    return int(records.num_rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Publish the newest records of a results folder.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("file", type=Path)
    words = parser.parse_args()
    Console().print(f"{publish(words.folder, words.file)} episodes in {words.file}")
