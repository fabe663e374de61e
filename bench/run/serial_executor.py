"""Carries out tasks in this process, one after the other."""

from __future__ import annotations

import contextlib
import io
import signal
import threading
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

from cavbench.isolation.foreign import StopUnitError
from cavbench.isolation.framework import Snapshot
from cavbench.isolation.settings import Settings
from cavbench.run.attempt import attempt
from cavbench.run.blame import blamed
from cavbench.run.executor import Finished, Watcher
from cavbench.run.process import settle
from cavbench.run.task import Limits, Outcome, Task


class SerialExecutor:
    """Carries out the tasks in this process, one after the other.

    It cannot survive a component that ends the process, nor end one that hangs in a library's code, nor limit memory.

    Args:
        limits: of each task.
    """

    size = 1
    beside = False

    def __init__(self, limits: Limits) -> None:
        self.limits = limits

    def map(self, tasks: Iterable[Task], watcher: Watcher) -> Generator[list[Finished], None, None]:
        settle()
        framework, settings, culprit = Snapshot(), Settings(), ""
        waiting, parts = iter(tasks), deque[Task]()
        while (task := parts.popleft() if parts else next(waiting, None)) is not None:
            if culprit:
                why = f"was not driven: {culprit} changed this process; use executor=processes"
                yield [(task, Outcome(why=why))]
                continue
            watcher.working([task])
            outcome, text = self._carried_out(task, watcher, framework)
            # The next unit must not be driven with what this one set.
            settings.restore()
            if lines := [line for line in text.splitlines() if line.strip()]:
                watcher.printed(task, lines)
            if outcome.tampered:
                culprit = str(task)
            elif outcome.lost and task.others:
                # Each unit alone says which one it was.
                parts.extend(task.each)
                continue
            yield [(task, outcome)]

    def _carried_out(self, task: Task, watcher: Watcher, framework: Snapshot) -> tuple[Outcome, str]:
        """The outcome of a task, and what it printed to standard output."""
        with contextlib.redirect_stdout(io.StringIO()) as output:
            try:
                with _time_limit(self.limits.seconds):
                    outcome = attempt(task, watcher.preparing, framework)
            except StopUnitError:
                why = f"failed: it took longer than unit_timeout={self.limits.seconds:g} seconds"
                outcome = Outcome(why=why + blamed(task.pair), lost=True)
        return outcome, output.getvalue()

    def close(self) -> None:
        pass


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    """Raise StopUnitError after so many seconds, if this is the main thread; 0 for no limit."""
    if not (seconds and hasattr(signal, "setitimer")) or threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise StopUnitError

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
