"""Tables of records whose text is dictionary-encoded: reads one from a file, puts several together, and numbers equal rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cavbench.core.track import Track
from cavbench.errors import UserError
from cavbench.records.schema import encoded, schema

MOST_ROWS = 2**21
"""Most records of a file: a few bytes can state more rows than a machine has memory for."""
MOST_IN_LISTS = 2**26
"""Most numbers in the lists of a file."""


def read_table(path: Path, track: Track, names: Sequence[str] | None = None) -> pa.Table:
    """The records of a file, of which `track_of` has told the track.

    Args:
        path: the file.
        track: its track.
        names: columns to read; None reads all.

    Raises:
        UserError: if the file is truncated, or states too much.
    """
    wanted = encoded(track, names)
    try:
        file = pq.ParquetFile(path, read_dictionary=[one.name for one in schema(track) if pa.types.is_string(one.type)])
        _check_size(file, path)
        records = _completed(file.read(columns=wanted.names, use_threads=False), wanted)
        # Arrow believes a file that its text is UTF-8, and where its lists end.
        records.validate(full=True)
        return together([records.cast(wanted)])
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = "missing" if isinstance(error, FileNotFoundError) else "truncated or not Parquet"
        raise UserError(f"the record {path} is {reason}; delete it and run again to recreate it") from None


def _completed(records: pa.Table, wanted: pa.Schema) -> pa.Table:
    """The records with the nullable columns that there were not yet when they were written."""
    for column in wanted:
        if column.nullable and column.name not in records.column_names:
            records = records.append_column(column, pa.nulls(records.num_rows, column.type))
    return records.select(wanted.names)


def _check_size(file: pq.ParquetFile, path: Path) -> None:
    told = file.metadata
    groups = [told.row_group(number) for number in range(told.num_row_groups)]
    within = sum(group.column(place).num_values for group in groups for place in range(group.num_columns))
    if told.num_rows > MOST_ROWS or within > MOST_ROWS * told.num_columns + MOST_IN_LISTS:
        raise UserError(f"the record {path} states more than {MOST_ROWS} rows; delete it and run again to recreate it")


def together(tables: Sequence[pa.Table]) -> pa.Table:
    """One table of several with the same columns. Its text columns have one dictionary each, without a text twice."""
    whole = pa.concat_tables(tables).unify_dictionaries().combine_chunks()
    for place, name in enumerate(whole.column_names):
        column = whole[name]
        if pa.types.is_dictionary(column.type) and _repeats(column):
            # A stranger's dictionary may hold a text twice, which would make two of one.
            whole = whole.set_column(place, whole.field(name), column.cast(pa.string()).dictionary_encode())
    return whole


def plain(records: pa.Table) -> pa.Table:
    """The records with text that is not encoded, as it is written to a file."""
    kinds = [one.with_type(pa.string()) if pa.types.is_dictionary(one.type) else one for one in records.schema]
    return records.cast(pa.schema(kinds, metadata=records.schema.metadata))


def _repeats(column: pa.ChunkedArray) -> bool:
    return any(len(pc.unique(chunk.dictionary)) != len(chunk.dictionary) for chunk in column.chunks)


def group_codes(records: pa.Table, columns: Sequence[str]) -> NDArray[np.int64]:
    """A number for each record, the same for those that share the values of `columns`; from 0, without a gap.

    Args:
        records: of any columns; text may be dictionary-encoded.
        columns: names, at least one.
    """
    found = np.zeros(records.num_rows, np.int64)
    for name in columns:
        column = records[name].combine_chunks()
        column = column if pa.types.is_dictionary(column.type) else column.dictionary_encode()
        found = _dense(found * (len(column.dictionary) + 1) + of_texts(column))
    return found


def of_texts(column: pa.DictionaryArray) -> NDArray[np.int64]:
    """The place of each record's text in the dictionary, or the length of the dictionary where there is none."""
    return pc.fill_null(column.indices, len(column.dictionary)).to_numpy(zero_copy_only=False)


def _dense(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """The numbers of groups, renamed to 0, 1, ... in their order."""
    highest = int(numbers.max(initial=-1)) + 1
    if highest > 4 * len(numbers) + 1024:
        return np.unique(numbers, return_inverse=True)[1]
    there = np.zeros(highest, bool)
    there[numbers] = True
    return (np.cumsum(there) - 1)[numbers]
