"""Our own published records, shipped with the package."""

from __future__ import annotations

from importlib.resources import as_file, files

import pyarrow as pa
import pyarrow.parquet as pq

from bench.results import SCHEMA


def published() -> pa.Table:
    """Every record in `leaderboard/data/*.parquet`, an empty table if none is shipped."""
    tables = []
    with as_file(files("leaderboard") / "data") as folder:
        for path in sorted(folder.glob("*.parquet")):
            table = pq.read_table(path)
            tables.append(table.select(SCHEMA.names).cast(SCHEMA))
    return pa.concat_tables(tables) if tables else SCHEMA.empty_table()
