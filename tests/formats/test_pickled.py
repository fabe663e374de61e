"""A pickle is read as data, in a time and a memory that its size bounds."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from cavbench.formats.pickled import array, floats, read

DOUBLED = 4
"""So often something is put twice into the next one. With a few dozen its text or its hash would have no end."""


def doubled(begin: bytes, wrap: bytes) -> bytes:
    """Operations after which the stack holds a tree, of which each level is there once."""
    operations = begin
    for level in range(DOUBLED):
        place = bytes([level])
        operations += b"q" + place + b"0" + b"h" + place + b"h" + place + wrap
    return operations


TREE = doubled(b")", b"\x86")
"""Tuples of two."""


@pytest.mark.parametrize(
    "operations",
    [
        TREE + b"\x8c\x01a\x93",
        b"\x8c\x01a" + TREE + b"\x93",
        b"}" + TREE + b"Ns",
        b"}(" + TREE + b"Nu",
        b"cbuiltins\ndict\n)R" + TREE + b"Ns",
    ],
    ids=["module", "name", "key", "keys", "key of an object"],
)
def test_what_holds_itself_many_times_over_is_refused(operations: bytes) -> None:
    content = b"\x80\x04" + operations + b"."
    with pytest.raises(ValueError, match="not a pickle that is read as data"):
        read(content)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_an_array_is_read_without_being_made(protocol: int, kind: type) -> None:
    numbers = np.arange(6, dtype=kind).reshape(2, 3)
    found = array(read(pickle.dumps(numbers, protocol)))
    if protocol > 2:
        assert found is not None
        assert np.array_equal(found, numbers)
    assert floats("", 3) is None


def test_a_dict_of_texts_and_numbers_is_read() -> None:
    held = {"a": [1, 2.5, None], 3: ("x", b"y"), None: {"b": True}}
    assert read(pickle.dumps(held)) == held
