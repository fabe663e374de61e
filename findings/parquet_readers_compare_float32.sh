#!/usr/bin/env bash
# One guesses: readers agree which rows of a float32 column are 0.1: none, as the float32 is 0.10000000149; or all.
# What happens: DuckDB and polars make a float32 of the 0.1 in the filter and find all; a filter of pyarrow makes a float64 of the column and
# finds none. pandas finds none with `filters=`, which are pyarrow's, and all after reading.
# Versions: duckdb 2.0.1, polars 2.1.0, pyarrow 26.0.1, pandas 3.1.1. Source: selecting a budget of 0.1 from records of two benchmarks.
source "$(dirname "$0")/fresh.sh"
fresh duckdb==2.0.1 pyarrow==26.0.1 polars==2.1.0 pandas==3.1.1
see <<'P'
import duckdb
import pandas
import polars
import pyarrow as pa
import pyarrow.parquet as pq

pq.write_table(pa.table({"budget": pa.array([0.1, 0.1, 0.2], pa.float32())}), "records.parquet")
found = {
    "duckdb": len(duckdb.sql("select * from 'records.parquet' where budget = 0.1").fetchall()),
    "polars": polars.scan_parquet("records.parquet").filter(polars.col("budget") == 0.1).collect().height,
    "pyarrow": pq.read_table("records.parquet", filters=[("budget", "==", 0.1)]).num_rows,
    "pandas, filters=": len(pandas.read_parquet("records.parquet", filters=[("budget", "==", 0.1)])),
    "pandas, after reading": int((pandas.read_parquet("records.parquet").budget == 0.1).sum()),
}
print(
    f"duckdb {duckdb.__version__}, polars {polars.__version__}, pyarrow {pa.__version__}, pandas {pandas.__version__}: "
    f"of 2 rows of 0.1 are found: {found}"
)
raise SystemExit(found != {"duckdb": 2, "polars": 2, "pyarrow": 0, "pandas, filters=": 0, "pandas, after reading": 2})
P
