"""A command ends, whatever thread or hook a plug-in left, and says whose it was."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from cavbench.core import registry
from cavbench.errors import UserError
from cavbench.isolation.tree import resident_bytes
from cavbench.run.process_executor import ProcessExecutor
from cavbench.run.worker import Limits
from tests.command import import_path
from tests.plugins.distributions import install

COMMAND = """
import sys, threading
from cavbench.cli import ending
from cavbench.core import registry
ending.END_S, ending.BACKSTOP_S = 1.0, 0.5

def command():
    print("all is said")
    registry.resolve("cavbench.attacks", "slow_end", "attack")()
    sys.exit(3)

ending.ended(command)
"""
LATE = {
    "a thread": (
        "def main(): threading.Thread(target=wait, name='late').start()",
        "the thread 'late' of cavbench-late 2.0 does not end",
    ),
    "a thread without code of its own": (
        "def main(): threading.Thread(target=time.sleep, args=(99,)).start()",
        "of one of cavbench-late 2.0 does not end",
    ),
    "two threads": (
        "def main(): [threading.Thread(target=wait).start() for _ in range(2)]",
        "2 threads of cavbench-late 2.0 do not end",
    ),
    "a hook": (
        "def main(): atexit.register(wait)",
        "a hook for the end of the process of cavbench-late 2.0 does not end",
    ),
    "a hook that swallows all": (
        "def main(): atexit.register(stubborn)",
        "a hook for the end of the process of cavbench-late 2.0 does not end",
    ),
    "an object that waits when it is deleted": ("def main(): global kept; kept = Kept()", ""),
    "no function that a new thread calls first": (
        "def main(): del threading.get_native_id; del time.sleep; atexit.register(spin)",
        "a hook for the end of the process of cavbench-late 2.0 does not end",
    ),
    "nothing": ("def main(): atexit.register(print, 'and the hooks are heard')", ""),
}
HEAD = """
import atexit, threading, time
def wait(): time.sleep(99)
def spin():
    while True: pass
def stubborn():
    while True:
        try: wait()
        except BaseException: pass
class Kept:
    def __del__(self): wait()
"""


def ended(folder: Path, code: str) -> subprocess.CompletedProcess[str]:
    """A command that ends after it has called the code's `main`, which a plug-in of the package cavbench-late has."""
    install(folder, "cavbench-late", {"cavbench.attacks": {"slow_end": "late:main"}}, {"late": HEAD + code}, "2.0")
    return subprocess.run(
        [sys.executable, "-c", COMMAND],
        env={"PYTHONPATH": import_path(folder), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.parametrize("what", LATE)
def test_a_command_ends_whatever_a_plugin_left(what: str, tmp_path: Path) -> None:
    code, said = LATE[what]
    start = time.monotonic()
    found = ended(tmp_path, code)
    assert time.monotonic() - start < 20
    assert found.returncode == 3
    assert found.stdout.startswith("all is said\n")
    if said:
        assert found.stderr == f"warning: the command is ended, although {found.stderr.partition('although ')[2]}"
        assert said in found.stderr
        assert found.stderr.count("\n") == 1
    else:
        assert found.stderr == ""
    if what == "nothing":
        assert found.stdout.endswith("and the hooks are heard\n")


def test_a_command_ends_the_processes_that_a_plugin_left(tmp_path: Path) -> None:
    started = (
        "subprocess.Popen(['sleep', '96'])",
        "subprocess.Popen(['sleep', '96'], start_new_session=True)",
        "os.fork() or (os.setsid(), os.execlp('sleep', 'sleep', '96'))",
    )
    found = ended(tmp_path, "import os, subprocess\ndef main():\n" + "".join(f"    {one}\n" for one in started))
    assert found.returncode == 3
    assert found.stderr == "warning: the command ended processes that one of cavbench-late 2.0 left: sleep\n"


def test_a_thread_that_fills_the_runs_own_process_stops_the_run_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    executor = ProcessExecutor(1, Limits(memory_gb=0.5))
    executor._check_own_memory(resident_bytes(os.getpid()))
    monkeypatch.setattr(registry, "_FOREIGN", {"late": "cavbench-late 2.0"})
    code: dict[str, Any] = {"__name__": "late.inner"}
    exec("def fill(end): end.wait(30)", code)
    end = threading.Event()
    threading.Thread(target=code["fill"], args=(end,), name="filler", daemon=True).start()
    try:
        with pytest.raises(
            UserError, match=r"grew by .* GB, more than unit_memory=0.5 GB, by the thread 'filler' of cavbench-late 2.0"
        ):
            executor._check_own_memory(resident_bytes(os.getpid()) - 600_000_000)
    finally:
        end.set()
