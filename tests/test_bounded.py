"""What is no regular file, is too large, or is nested too deeply is one line, at once, wherever a path can be given."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from cavbench import bounded
from cavbench.archive import Archive
from cavbench.detection.victims import yolov5_file
from cavbench.detection.victims.reading import _listed
from cavbench.errors import UserError
from cavbench.formats.trial import hashed
from cavbench.records import columns

GIB = 2**30


def pipe(path: Path) -> None:
    os.mkfifo(path)


def bound_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        # Its name has at most 107 bytes.
        before = os.getcwd()
        os.chdir(path.parent)
        made.bind(path.name)
        os.chdir(before)


def sparse(path: Path) -> None:
    """20 GB without a block on the disk."""
    with path.open("wb") as file:
        file.truncate(20 * GIB)
        file.seek(-8, os.SEEK_END)
        file.write(b"\xff\xff\xff\xffPAR1")


def zero(path: Path) -> None:
    path.symlink_to("/dev/zero")


MADE: dict[str, Callable[[Path], None]] = {
    "pipe": pipe,
    "socket": bound_socket,
    "sparse file": sparse,
    "device": zero,
    "folder": lambda path: path.mkdir(),
}
READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "a file's hash": (".onnx", lambda path: hashed(str(path), "policy")),
    "an archive": (".zip", Archive.read),
    "weights": (".safetensors", yolov5_file.read),
    "a checkpoint": (".pt", yolov5_file.read),
    "JSON": (".json", bounded.read_json),
    "a record": (".parquet", columns.track_of),
}


@pytest.mark.parametrize("made", MADE)
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_file_of_a_proper_size_is_one_line_at_once(made: str, reader: str, tmp_path: Path) -> None:
    ending, read = READERS[reader]
    path = tmp_path / f"given{ending}"
    MADE[made](path)
    start = time.monotonic()
    with pytest.raises(UserError) as error:
        read(path)
    assert "\n" not in str(error.value)
    assert time.monotonic() - start < 5


def test_a_list_of_names_is_a_file_or_no_file(tmp_path: Path) -> None:
    sparse(tmp_path / "names")
    with pytest.raises(UserError, match=r"has 21\.5 GB, at most 1\.0 MB are allowed"):
        _listed(str(tmp_path / "names"))
    pipe(tmp_path / "pipe")
    assert _listed(str(tmp_path / "pipe")) == (str(tmp_path / "pipe"),)


def test_a_pipe_that_takes_the_place_of_a_file_does_not_hold_us(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "given"
    path.write_bytes(b"text")
    looked = bounded.size

    def exchanged(path: Path, **how: object) -> int:
        found = looked(path, **how)  # type: ignore[arg-type]
        path.unlink()
        os.mkfifo(path)
        return found

    monkeypatch.setattr(bounded, "size", exchanged)
    with pytest.raises(UserError, match="it is a pipe, not a file"):
        bounded.content(path, most=100)


def test_a_file_that_grows_while_it_is_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "given"
    path.write_bytes(b"text")
    with bounded.opened(path, most=100) as file:
        pieces = bounded.chunks(file, name="given")
        assert next(pieces) == b"text"
        with path.open("ab") as more:
            more.write(b"more")
        with pytest.raises(UserError, match="given was changed while it was read"):
            list(pieces)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[" * 100_000, "nested deeper"),
        ('{"a":' * 100_000, "nested deeper"),
        ("[" * 70 + "]" * 70, "nested deeper"),
        ('{"a": 1, "a": 2}', "'a' twice"),
        ('{"a": NaN}', "NaN is not JSON"),
        ("1e999", "too large"),
        ("9" * 5000, "digits"),
        ('"\\ud800"', "half of a surrogate pair"),
        ("\xff", "not JSON"),
        (b"\xff", "not text in UTF-8"),
        ("", "not JSON"),
    ],
)
def test_json_that_readers_could_read_otherwise_is_refused(text: str | bytes, why: str) -> None:
    with pytest.raises(ValueError, match=why) as error:
        bounded.parsed(text)
    assert "\n" not in str(error.value)


def test_json_is_read(tmp_path: Path) -> None:
    assert bounded.parsed('{"a": [1, 2.5, null, {"b": "\\u00e4\\ud83d\\ude00"}]}') == {
        "a": [1, 2.5, None, {"b": "ä😀"}]
    }
