"""Looks into an ONNX file before ONNX Runtime opens it: which other files does it read?

A tensor of an ONNX model may lie in another file, at any place of the disk that the model names. Here the protocol buffer is
walked without the onnx package, and every such name is checked.

Format: onnx.proto of ONNX 1.19 (messages and field numbers).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from bench.archive import LARGEST
from bench.errors import UserError

MESSAGES: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "function": {7: "node", 11: "attribute"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "tensor": {13: "entry"},
    "entry": {},
}
"""The messages that lead to a tensor, with their fields. `entry` is StringStringEntryProto: 1 is its key, 2 its value."""
DEEPEST = 100


def companions(path: Path, name: str) -> list[Path]:
    """The other files that a model reads its tensors from. They must lie in the folder of the model.

    Args:
        path: the model.
        name: its name in errors.

    Raises:
        UserError: if the file is not a model, or names a file elsewhere.
    """
    if path.stat().st_size > LARGEST:
        raise UserError(f"{name} is refused: it has more than {LARGEST >> 30} GiB")
    try:
        places = set(_locations(memoryview(path.read_bytes()), "model", 0))
    except ValueError as error:
        raise UserError(f"{name} cannot be read: it is not an ONNX model, or a damaged one") from error
    found = []
    for place in sorted(places):
        file = path.parent / place
        inside = place and "/" not in place and "\\" not in place and place != ".." and not file.is_symlink()
        if not inside:
            raise UserError(f"{name} is refused: it reads {place!r}; a model may read files in its own folder only")
        if not file.is_file():
            raise UserError(f"{name} cannot be read: it needs the file {file}")
        found.append(file)
    return found


def _locations(content: memoryview, message: str, depth: int) -> Iterator[str]:
    """The places of all external tensors in a message.

    Raises:
        ValueError: if it is not a protocol buffer.
    """
    if depth > DEEPEST:
        raise ValueError("nested too deeply")
    entry: dict[int, bytes] = {}
    for number, value in _fields(content):
        if message == "entry":
            entry[number] = bytes(value)
        elif number in MESSAGES[message]:
            yield from _locations(value, MESSAGES[message][number], depth + 1)
    if entry.get(1) == b"location":
        yield entry.get(2, b"").decode()


def _fields(content: memoryview) -> Iterator[tuple[int, memoryview]]:
    """The fields with a length: their numbers and contents; numbers of fixed or variable size are skipped."""
    place = 0
    while place < len(content):
        key, place = _varint(content, place)
        match key & 7:
            case 0:
                _, place = _varint(content, place)
            case 1:
                place += 8
            case 5:
                place += 4
            case 2:
                length, place = _varint(content, place)
                if place + length > len(content):
                    raise ValueError("truncated")
                yield key >> 3, content[place : place + length]
                place += length
            case _:
                raise ValueError("a wire type that ONNX does not use")
    if place != len(content):
        raise ValueError("truncated")


def _varint(content: memoryview, place: int) -> tuple[int, int]:
    """The whole number at a place, and the place behind it."""
    number = 0
    for shift in range(0, 70, 7):
        if place >= len(content):
            raise ValueError("truncated")
        byte = content[place]
        place += 1
        number |= (byte & 127) << shift
        if byte < 128:
            return number & (2**64 - 1), place
    raise ValueError("a number of more than 64 bits")
