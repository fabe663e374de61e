"""Changed files of every kind are read, or refused in one line: no traceback, no code, little time and memory.

A few files of each kind, the same in every run; `make soak` tries them for an hour.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

from cavbench.errors import UserError
from tests.soak.fuzzing import trial
from tests.soak.fuzzing.campaign import tried
from tests.soak.fuzzing.readers import READERS
from tests.soak.fuzzing.trial import Trials

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory is measured as Linux says it")
COUNT = 30


@pytest.mark.parametrize("name", READERS)
def test_changed_files_are_read_or_refused_in_one_line(name: str) -> None:
    reader = READERS[name]
    with Trials(reader.read, reader.refusals, guarded=reader.guarded) as trials:
        first = trials.tried(reader.valid())
        assert first.kind == "read", first.text
        found = tried(reader, trials, COUNT, 0)
    assert [verdict.text for verdict, _ in found if verdict.kind == "wrong"] == []
    assert len(found) == COUNT
    assert any(verdict.kind == "refused" for verdict, _ in found)


def harm(what: str, folder: Path) -> None:
    match what:
        case "traceback":
            raise KeyError("x")
        case "lines":
            raise UserError("one\ntwo")
        case "hang":
            while True:
                pass
        case "idle":
            time.sleep(600)
        case "memory":
            bytearray(800_000_000)
        case "code":
            __import__("subprocess").run("true", check=False)
        case "file":
            (Path.home() / "made").write_text("")
        case "end":
            __import__("os").abort()


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("traceback", "KeyError: 'x'"),
        ("lines", "one\ntwo"),
        ("hang", "s of a core"),
        ("idle", "does not end"),
        ("memory", "MB (read )"),
        ("code", "it does subprocess.Popen"),
        ("file", "it does open"),
        ("end", "ends the process (-6)"),
    ],
)
def test_each_thing_that_goes_wrong_is_seen(
    what: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trial, "CPU_S", 2.0)
    monkeypatch.setattr(trial, "STUCK_S", 2.0)
    monkeypatch.setenv("HOME", str(tmp_path))
    with Trials(lambda folder: harm(what, folder), (UserError,)) as trials:
        verdict = trials.tried({"x": b""})
        assert verdict.kind == "wrong"
        assert said in verdict.text
        # The next file is read in a new process, where the last one ended it.
        assert trials.tried({"x": b""}).kind == "wrong"


def test_memory_that_was_freed_before_does_not_hide_what_a_reader_takes(tmp_path: Path) -> None:
    blocks = [bytes(100_000) for _ in range(10_000)]
    last = bytes(100_000)
    del blocks
    with Trials(lambda folder: harm("memory", folder), (UserError,)) as trials:
        assert "MB (read )" in trials.tried({"x": b""}).text
    assert len(last) == 100_000
