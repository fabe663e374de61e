"""A copy of a process with threads may be stuck from the start: this is no harm that the act does."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from cavbench.isolation.foreign import harm

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="there is a copy of the process on Linux only")


class Waits:
    """Garbage that waits, in any process but its own, for a thread that is not there."""

    def __init__(self) -> None:
        self.itself, self.process = self, os.getpid()

    def __del__(self) -> None:
        if os.getpid() != self.process:
            threading.Event().wait()


@pytest.fixture
def uncollected() -> Iterator[None]:
    gc.disable()
    yield
    gc.enable()
    gc.collect()


def test_garbage_of_the_process_is_not_collected_in_its_copy(uncollected: None) -> None:
    Waits()
    assert harm(gc.collect, 5) == ""


def test_the_copy_collects_its_own_garbage(tmp_path: Path) -> None:
    class Tells:
        def __init__(self) -> None:
            self.itself = self

        def __del__(self) -> None:
            (tmp_path / "collected").touch()

    def act() -> None:
        assert gc.isenabled()
        Tells()
        gc.collect()

    assert harm(act, 30) == ""
    assert (tmp_path / "collected").exists()


class Stuck:
    """Does nothing for a minute the first times; each call in a copy of the process leaves a file."""

    def __init__(self, place: Path, times: int) -> None:
        self.place, self.times = place, times

    def __call__(self) -> None:
        (self.place / str(self.tries())).touch()
        if self.tries() <= self.times:
            threading.Event().wait(60)

    def tries(self) -> int:
        return len(list(self.place.iterdir()))


def test_a_copy_that_is_stuck_is_made_once_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cavbench.isolation.foreign.STUCK_S", 2)
    stuck = Stuck(tmp_path, times=1)
    assert harm(stuck, 30) == ""
    assert stuck.tries() == 2


def test_an_act_that_always_waits_does_not_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cavbench.isolation.foreign.STUCK_S", 2)
    stuck = Stuck(tmp_path, times=2)
    assert harm(stuck, 4) == "does not end within 4 s"
    assert stuck.tries() == 2


def test_an_act_that_works_without_end_is_tried_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def act() -> None:
        (tmp_path / str(time.monotonic())).touch()
        while True:
            pass

    monkeypatch.setattr("cavbench.isolation.foreign.STUCK_S", 2)
    assert harm(act, 6) == "does not end within 6 s"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.skipif(
    not Path("/proc/self/schedstat").exists(), reason="the kernel does not say how long a process waited"
)
def test_the_time_that_a_copy_waits_for_a_core_is_not_its_own() -> None:
    cores = os.sched_getaffinity(0)

    def work() -> None:
        end = time.process_time() + 1.5
        while time.process_time() < end:
            pass

    os.sched_setaffinity(0, {min(cores)})
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    try:
        begin = time.monotonic()
        assert harm(work, 2) == ""
        assert time.monotonic() - begin > 2
    finally:
        os.sched_setaffinity(0, cores)
        for other in others:
            other.kill()
            other.wait()
