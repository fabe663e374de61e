"""How much a Parquet file unpacks to, by the headers of its pages, before any page is unpacked.

The footer of a file may lie. What a reader allocates follows the headers of the pages, which the Parquet format writes as
Thrift structures in the compact protocol (parquet.thrift and thrift-compact-protocol.md of the two projects). They are read
strictly here: a header that a reader could understand in two ways is refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import pyarrow.parquet as pq

DATA, DICTIONARY, DATA_V2 = 0, 2, 3
"""Types of pages (`PageType`) that records have."""
HEADERS = {DATA: 5, DICTIONARY: 7, DATA_V2: 8}
"""The field of a page's header with the header of its type. Its own first field is the number of values."""
MOST_FIELDS = 12
"""Most fields of a structure of a page's header; the longest has eight."""
DEEPEST = 3
"""Deepest structure in a page's header: statistics in the header of a data page."""
TRUE, FALSE, BYTE, I16, I32, I64, BINARY, STRUCT = 1, 2, 3, 4, 5, 6, 8, 12
"""Types of the compact protocol that the headers of pages use."""
VALUE = 8
"""Most bytes of a value of a fixed size."""


@dataclass
class Reader:
    """A Thrift structure in the compact protocol, from `at` on."""

    data: bytes
    at: int

    def struct(self, depth: int = 1) -> dict[int, object]:
        """The fields of a structure by their number; each at most once, in ascending order."""
        found: dict[int, object] = {}
        last = 0
        while (head := self._byte()) != 0:
            delta, kind = head >> 4, head & 15
            if not delta or len(found) == MOST_FIELDS or depth > DEEPEST:
                raise ValueError("header of a page")
            last += delta
            found[last] = self._value(kind, depth)
        return found

    def _value(self, kind: int, depth: int) -> object:
        if kind in (TRUE, FALSE):
            return kind == TRUE
        if kind == BYTE:
            return self._byte()
        if kind in (I16, I32, I64):
            number = self._varint()
            return (number >> 1) ^ -(number & 1)
        if kind == STRUCT:
            return self.struct(depth + 1)
        if kind == BINARY:
            length = self._varint()
            self.at += length
            return None
        raise ValueError("header of a page")

    def _varint(self) -> int:
        number = shift = 0
        while True:
            byte = self._byte()
            number |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return number
            if shift > 63:
                raise ValueError("header of a page")

    def _byte(self) -> int:
        if self.at >= len(self.data):
            raise ValueError("header of a page")
        self.at += 1
        return self.data[self.at - 1]


def unpacked(data: bytes, footer: pq.FileMetaData) -> int:
    """Most bytes that the values of a file have in memory, if its texts are read as dictionaries.

    Args:
        data: the file.
        footer: its footer, as `pyarrow.parquet` reads it.

    Returns:
        The bytes of all pages unpacked, and `VALUE` bytes for each value.

    Raises:
        ValueError: if the pages are not where the footer says, or do not hold as many values as it says.
    """
    total = 0
    for group in range(footer.num_row_groups):
        row_group = footer.row_group(group)
        for column in range(row_group.num_columns):
            total += _column(data, row_group.column(column))
    return total


def _column(data: bytes, column: pq.ColumnChunkMetaData) -> int:
    """The same for a column of a row group."""
    first = column.data_page_offset
    if column.has_dictionary_page:
        if not 0 < column.dictionary_page_offset < first:
            raise ValueError("offset of a dictionary")
        first = column.dictionary_page_offset
    end = first + column.total_compressed_size
    if not 0 < first < end <= len(data):
        raise ValueError("offset of a column")
    size = values = 0
    at, dictionary = first, column.has_dictionary_page
    while at < end:
        reader = Reader(data[:end], at)
        page = reader.struct()
        kind, bytes_unpacked, bytes_packed = (page.get(number) for number in (1, 2, 3))
        if not (isinstance(kind, int) and isinstance(bytes_unpacked, int) and isinstance(bytes_packed, int)):
            raise ValueError("header of a page")
        own = page.get(HEADERS.get(kind, 0))
        count = own.get(1) if isinstance(own, dict) else None
        if not isinstance(count, int) or min(count, bytes_unpacked, bytes_packed) < 0:
            raise ValueError("header of a page")
        if (kind == DICTIONARY) != dictionary:
            raise ValueError("a dictionary's place")
        dictionary = False
        size += bytes_unpacked + VALUE * count
        values += count if kind != DICTIONARY else 0
        at = reader.at + bytes_packed
    if at != end or values != column.num_values:
        raise ValueError("values of a column")
    return size
