"""What a Parquet file unpacks to is known from the headers of its pages, whatever its footer says."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavbench.records.pages import Reader, unpacked

TEXT = "a long text " * 1000


def table(rows: int) -> pa.Table:
    random = np.random.default_rng(0)
    return pa.table(
        {
            "text": [TEXT] * rows,
            "number": random.normal(size=rows),
            "missing": pa.array([None, 1] * (rows // 2) + [None] * (rows % 2), pa.int32()),
            "flag": random.random(rows) < 0.5,
            "list": [[0.0] * (number % 7) for number in range(rows)],
        }
    )


def written(data: pa.Table, **options: Any) -> bytes:
    file = BytesIO()
    pq.write_table(data, file, **options)
    return file.getvalue()


def footer(content: bytes) -> pq.FileMetaData:
    return pq.read_metadata(pa.BufferReader(content))


@settings(deadline=None, max_examples=60)
@given(
    rows=st.integers(1, 300),
    compression=st.sampled_from(["zstd", "snappy", "gzip", "none"]),
    version=st.sampled_from(["1.0", "2.0"]),
    page=st.sampled_from([100, 5000, 2**20]),
    group=st.integers(1, 400),
    dictionary=st.booleans(),
)
def test_the_bound_holds_for_every_way_to_write_a_file(
    rows: int, compression: str, version: str, page: int, group: int, dictionary: bool
) -> None:
    content = written(
        table(rows),
        compression=compression,
        data_page_version=version,
        data_page_size=page,
        row_group_size=group,
        use_dictionary=dictionary,
    )
    read = pq.read_table(pa.BufferReader(content), read_dictionary=["text"])
    # Arrow rounds the places of a list up to a whole number per row, and has one bit a value for what is missing.
    assert unpacked(content, footer(content)) + 8 * (rows + 64 * read["text"].num_chunks) >= read.nbytes


def test_values_that_take_no_bytes_in_the_file_are_counted() -> None:
    content = written(pa.table({"list": [[0.0] * 1_000_000] * 4}), compression="zstd")
    assert len(content) < 5_000
    assert unpacked(content, footer(content)) >= 4 * 8_000_000


def test_a_page_that_unpacks_to_more_than_the_footer_says_is_counted() -> None:
    content = written(pa.table({"text": [TEXT]}), compression="zstd", use_dictionary=False)
    reader = Reader(content, column(content).data_page_offset)
    honest = unpacked(content, footer(content))
    size = reader.struct()[2]
    assert isinstance(size, int)
    # The size of the page as a varint in zigzag: as many bytes, but more.
    old, new = varint(2 * size), varint(2 * 1_000_000)
    assert len(old) == len(new)
    forged = content.replace(old, new, 1)
    assert footer(forged) == footer(content)
    assert unpacked(forged, footer(forged)) == honest + 1_000_000 - size


def test_pages_that_are_not_where_the_footer_says_are_refused() -> None:
    content = written(pa.table({"number": np.arange(50.0)}))
    start, size = column(content).dictionary_page_offset, column(content).total_compressed_size
    about = footer(content)
    for cut in (b"\x00" * size, b"\xff" * size, b"\x15" * size):
        with pytest.raises(ValueError, match="header of a page"):
            unpacked(content[:start] + cut + content[start + size :], about)
    with pytest.raises(ValueError, match="offset of a column"):
        unpacked(content[: start + size - 1], about)


@given(st.binary(max_size=60))
def test_any_bytes_end_as_a_structure_or_an_error(content: bytes) -> None:
    try:
        found = Reader(content, 0).struct()
    except ValueError:
        return
    assert list(found) == sorted(found)


def varint(number: int) -> bytes:
    found = bytearray()
    while number >= 0x80:
        found.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*found, number])


def column(content: bytes) -> pq.ColumnChunkMetaData:
    return footer(content).row_group(0).column(0)
