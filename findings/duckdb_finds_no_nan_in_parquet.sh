#!/usr/bin/env bash
# One guesses: `where isnan(v)` counts the NaN of a Parquet file, and `v <> 1` those of a column of 1 and NaN.
# What happens: bounds in a Parquet footer leave NaN out, as its format says. DuckDB skips the row group by them: it finds no NaN, and all of
# them without bounds or from memory. A filter of pyarrow misses them, too; a filter after reading does not, and neither does polars.
# Versions: duckdb 2.0.1, pyarrow 26.0.1, polars 2.1.0. Source: times to a collision that are NaN where there is no other car.
source "$(dirname "$0")/fresh.sh"
fresh duckdb==2.0.1 pyarrow==26.0.1 polars==2.1.0
see <<'P'
import duckdb
import polars
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

values = pa.table({"v": [1.0, 1.0, float("nan")]})
pq.write_table(values, "bounds.parquet")
pq.write_table(values, "without.parquet", write_statistics=False)


def found(file):
    """Rows that are NaN by DuckDB, and that differ from 1 by DuckDB, by a filter of pyarrow, by one after reading, and by polars."""
    nan, other = (len(duckdb.sql(f"select v from '{file}' where {words}").fetchall()) for words in ("isnan(v)", "v <> 1"))
    pushed = pq.read_table(file, filters=[("v", "!=", 1.0)]).num_rows
    return nan, other, pushed, pq.read_table(file).filter(pc.field("v") != 1).num_rows, (
        polars.scan_parquet(file).filter(polars.col("v") != 1).collect().height
    )


bounds, without = found("bounds.parquet"), found("without.parquet")
print(
    f"duckdb {duckdb.__version__}, pyarrow {pa.__version__}, polars {polars.__version__}: one NaN in three rows: isnan by DuckDB, not 1 by "
    f"DuckDB, pyarrow's filter, after reading, polars: {bounds}; without bounds {without}"
)
raise SystemExit(not (bounds == (0, 0, 0, 1, 1) and without == (1, 1, 1, 1, 1)))
P
