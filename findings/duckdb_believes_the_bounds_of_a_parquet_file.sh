#!/usr/bin/env bash
# One guesses: readers of Parquet agree on the rows of a file; the lowest and the highest value in its footer only make reading faster.
# What happens: pyarrow without a filter reads what is there. DuckDB and pyarrow with a filter skip rows by the footer: a file whose
# bounds are too narrow loses rows in the answer to `WHERE`, and `SELECT *` shows them.
# Versions: duckdb 2.0.0, pyarrow 26.0.1. Source: an audit of records that others send in.
source "$(dirname "$0")/fresh.sh"
fresh duckdb==2.0.0 pyarrow==26.0.1
see <<'P'
import struct

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq

# 3.0 is written over one bound in the footer: 9.0 becomes 3.0, in the statistics only.
pq.write_table(pa.table({"score": [1.0, 9.0]}), "scores.parquet", use_dictionary=False, compression="none")
content = bytearray(open("scores.parquet", "rb").read())
footer = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
place, old, new = footer, struct.pack("<d", 9.0), struct.pack("<d", 3.0)
while (place := content.find(old, place)) >= 0:
    content[place : place + 8] = new
open("scores.parquet", "wb").write(content)

rows = {
    "duckdb, all": duckdb.sql("select count(*) from 'scores.parquet'").fetchall()[0][0],
    "duckdb, score > 5": duckdb.sql("select count(*) from 'scores.parquet' where score > 5").fetchall()[0][0],
    "pyarrow, all, then > 5": sum(score > 5 for score in pq.read_table("scores.parquet")["score"].to_pylist()),
    "pyarrow, filter > 5": len(pq.read_table("scores.parquet", filters=[("score", ">", 5)])),
}
print(f"duckdb {duckdb.__version__}, pyarrow {pa.__version__}: rows {rows}")
raise SystemExit(not (rows["pyarrow, all, then > 5"] == 1 and rows["duckdb, score > 5"] == 0))
P
