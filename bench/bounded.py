"""Reads files of strangers: only regular files, no larger than allowed, and JSON that is flat enough to work with.

A size is checked before anything is read. A pipe, a device or a socket is refused before it is opened: it might never end.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from cavbench.errors import UserError, short

TEXT = 2**24
"""Most bytes of a text: a description, a card, a list of names."""
WEIGHTS = 2**30
"""Most bytes of weights, of a network or of records."""
DEEPEST = 64
"""Most levels of lists and objects in JSON."""
KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISLNK, "a link"),
)
CHUNK = 2**20


def size(path: Path, *, most: int, name: str = "", links: bool = True) -> int:
    """The size of a file in bytes; nothing is read.

    Args:
        path: the file.
        most: largest size.
        name: the file in errors; its path if there is none.
        links: whether it may be reached through a symbolic link.

    Raises:
        UserError: if it is missing, is no regular file, or is larger.
    """
    name = name or str(path)
    try:
        return _checked(path.stat() if links else path.lstat(), most, name)
    # A path with a zero byte is a ValueError.
    except (OSError, ValueError) as error:
        raise UserError(f"{name} cannot be read: {_reason(error)}") from None


@contextmanager
def opened(path: Path, *, most: int, name: str = "", links: bool = True) -> Iterator[BinaryIO]:
    """Open a file for reading; arguments and errors as of `size`.

    What is opened is checked again: the path may name another file by then.

    Raises:
        UserError: as `size`, and if the block raises OSError.
    """
    name = name or str(path)
    size(path, most=most, name=name, links=links)
    # A pipe that took the file's place must not hold us.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
    try:
        with open(os.open(path, flags | (0 if links else getattr(os, "O_NOFOLLOW", 0))), "rb") as file:
            _checked(os.fstat(file.fileno()), most, name)
            yield file
    except OSError as error:
        raise UserError(f"{name} cannot be read: {_reason(error)}") from None


def chunks(file: BinaryIO, *, name: str) -> Iterator[bytes]:
    """The content of a file of `opened`, piece by piece: as many bytes as it had when it was opened.

    Raises:
        UserError: if it has more or fewer.
    """
    left = os.fstat(file.fileno()).st_size
    while left:
        piece = file.read(min(CHUNK, left))
        if not piece:
            break
        left -= len(piece)
        yield piece
    if left or file.read(1):
        raise UserError(f"{name} was changed while it was read")


def content(path: Path, *, most: int, name: str = "", links: bool = True) -> bytes:
    """The content of a file; arguments and errors as of `opened`."""
    with opened(path, most=most, name=name, links=links) as file:
        return b"".join(chunks(file, name=name or str(path)))


def sha256(path: Path, *, most: int, name: str = "", links: bool = True) -> str:
    """The sha256 of a file, in hexadecimal; arguments and errors as of `opened`."""
    hasher = hashlib.sha256()
    with opened(path, most=most, name=name, links=links) as file:
        for piece in chunks(file, name=name or str(path)):
            hasher.update(piece)
    return hasher.hexdigest()


def read_json(path: Path, *, most: int = TEXT, name: str = "", finite: bool = True, links: bool = True) -> Any:
    """The value in a JSON file; arguments as of `size` and `parsed`.

    Raises:
        UserError: as `opened`, or if it is not JSON as `parsed` takes it.
    """
    found = content(path, most=most, name=name, links=links)
    try:
        return parsed(found, finite=finite)
    except ValueError as error:
        raise UserError(f"{name or path} cannot be read: {error}") from None


def parsed(text: str | bytes, *, finite: bool = True) -> Any:
    """The value of a JSON text (RFC 8259, in UTF-8), so that every reader finds the same in it.

    Args:
        text: the text.
        finite: whether its numbers must be finite; Python writes NaN, which is no JSON.

    Raises:
        ValueError: in one line, if it is not JSON, is nested deeper than `DEEPEST`, has a key twice, a number that is not
            finite, or half a character.
    """
    try:
        decoded = text.decode("utf-8") if isinstance(text, bytes) else text
        found = json.loads(decoded, object_pairs_hook=_distinct, **(FINITE if finite else {}))
    except RecursionError:
        raise ValueError(_DEEP) from None
    except UnicodeDecodeError:
        raise ValueError("it is not text in UTF-8") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"it is not JSON: {error}") from None
    _check(found)
    return found


def _checked(found: os.stat_result, most: int, name: str) -> int:
    if not stat.S_ISREG(found.st_mode):
        kind = next((kind for matches, kind in KINDS if matches(found.st_mode)), "something else")
        raise UserError(f"{name} is refused: it is {kind}, not a file")
    if found.st_size > most:
        raise UserError(f"{name} is refused: it has {spelled(found.st_size)}, at most {spelled(most)} are allowed")
    return found.st_size


def spelled(count: float) -> str:
    """A number of bytes for people: 3.0 GB."""
    for unit in ("bytes", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "bytes" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"


def _reason(error: OSError | ValueError) -> str:
    return (isinstance(error, OSError) and error.strerror) or str(error)


_DEEP = f"it is nested deeper than {DEEPEST} levels"


def _distinct(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"it has {short(next(name for name in names if names.count(name) > 1))!r} twice in an object")
    return found


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is not JSON")


def _finite(text: str) -> float:
    if (number := float(text)) in (float("inf"), float("-inf")):
        raise ValueError(f"the number {short(text)} is too large")
    return number


FINITE: Mapping[str, Any] = {"parse_constant": _no_number, "parse_float": _finite}


def _check(value: Any) -> None:
    """Raise ValueError if a value is nested too deeply or has half a character. Without recursion, which would need the stack."""
    level, depth = [value], 0
    while level:
        if depth > DEEPEST:
            raise ValueError(_DEEP)
        texts = [one for one in level if isinstance(one, str)]
        texts += [key for one in level if isinstance(one, dict) for key in one]
        try:
            for one in texts:
                one.encode()
        except UnicodeEncodeError:
            raise ValueError("it has half of a surrogate pair, which is no character") from None
        level = [
            inner
            for one in level
            if isinstance(one, dict | list)
            for inner in (one.values() if isinstance(one, dict) else one)
        ]
        depth += 1
