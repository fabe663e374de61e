"""A file appears whole or not at all."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cavbench.files import scratch, sweep, whole

KILLED = """
import os, signal, sys
from pathlib import Path
from cavbench.files import whole
with whole(Path(sys.argv[1])) as file:
    file.write(b"half")
    file.flush()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_an_exception_leaves_the_existing_file_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "record"
    path.write_bytes(b"old")

    def fail() -> None:
        with whole(path) as file:
            file.write(b"new")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["record"]


def test_a_killed_process_leaves_the_existing_file_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "record"
    path.write_bytes(b"old")
    died = subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False)
    assert died.returncode == -signal.SIGKILL
    assert path.read_bytes() == b"old"
    with whole(path) as file:
        file.write(b"new")
    assert path.read_bytes() == b"new"
    assert path.stat().st_mode & 0o777 == 0o644
    assert os.listdir(tmp_path) == ["record"]


def test_the_temporary_file_of_a_process_that_runs_is_kept(tmp_path: Path) -> None:
    with whole(tmp_path / "record") as file:
        (aside,) = tmp_path.iterdir()
        sweep(tmp_path)
        assert aside.exists()
        file.write(b"new")


def test_a_copy_of_the_process_does_not_delete_the_temporary_folder(tmp_path: Path) -> None:
    with scratch(tmp_path) as folder:
        own = os.getpid()
        try:
            with scratch(tmp_path) as inner:
                if (copy := os.fork()) == 0:
                    raise InterruptedError
                os.waitpid(copy, 0)
                assert inner.is_dir()
        finally:
            if os.getpid() != own:
                os._exit(0)
        assert folder.is_dir()
        assert not inner.exists()
    assert list(tmp_path.iterdir()) == []
