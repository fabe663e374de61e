"""Back ends that carry out tasks: `map(tasks)` yields the outcomes as soon as they are finished, in any order."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing.connection import wait
from types import FrameType
from typing import Protocol

from cavbench.core import registry
from cavbench.errors import UserError
from cavbench.isolation.foreign import StopUnitError
from cavbench.isolation.framework import Snapshot
from cavbench.isolation.settings import Settings
from cavbench.isolation.threads import holders
from cavbench.run.blame import blamed
from cavbench.run.process import cores, settle
from cavbench.run.tree import resident_bytes
from cavbench.run.unit import Loading, Preparation, Unit
from cavbench.run.work import Failure, Outcome, Task, attempt
from cavbench.run.worker import GB, Limits, Worker, packed

NEWS_S = 1.0
"""Seconds between two looks at the workers' time and memory."""
Finished = tuple[Task, Outcome | Failure]


class Watcher(Protocol):
    """Receives the progress of the work; the command line draws a progress bar."""

    def working(self, works: Sequence[Unit | Preparation | Loading]) -> None:
        """Called with the work in progress."""

    def preparing(self, work: str, share: float, text: str, episodes: int = 0) -> None:
        """Called with the share of some work done in [0, 1]; of a preparation with a text, of units with their episodes."""

    def printed(self, work: Unit | Preparation | Loading, lines: Sequence[str]) -> None:
        """Called with what the components printed while they worked."""


class Executor(Protocol):
    """A back end that carries out tasks. `size` is the number of tasks that it carries out at once."""

    size: int

    def map(self, tasks: Iterable[Task], watcher: Watcher) -> Generator[list[Finished], None, None]:
        """Carry out all tasks, and yield each with its outcome, or why it failed, as soon as it is finished.

        Tasks that finished at about the same time come together, so that their records can be written together.

        A task is taken when there is room for it. One whose process dies is tried a second time, because the first may have been
        an accident. Closing the generator stops the tasks in progress.
        """
        ...

    def close(self) -> None:
        """End all processes."""
        ...


class SerialExecutor:
    """Carries out the tasks in this process, one after the other.

    It cannot survive a component that ends the process, nor end one that hangs in a library's code, nor limit memory.

    Args:
        limits: of each task.
    """

    size = 1

    def __init__(self, limits: Limits) -> None:
        self.limits = limits

    def map(self, tasks: Iterable[Task], watcher: Watcher) -> Generator[list[Finished], None, None]:
        settle()
        framework, settings, culprit = Snapshot(), Settings(), ""
        waiting, parts = iter(tasks), deque[Task]()
        while (task := parts.popleft() if parts else next(waiting, None)) is not None:
            if culprit:
                why = f"was not driven: {culprit} changed this process; use executor=processes"
                yield [(task, Failure(why=why))]
                continue
            watcher.working([task.work, *task.others])
            outcome, text = self._carried_out(task, watcher, framework)
            # The next unit must not be driven with what this one set.
            settings.restore()
            if lines := [line for line in text.splitlines() if line.strip()]:
                watcher.printed(task.work, lines)
            if isinstance(outcome, Failure) and outcome.tampered:
                culprit = str(task.work)
            elif isinstance(outcome, Failure) and outcome.lost and task.others:
                # Each unit alone says which one it was.
                parts.extend(task.parts())
                continue
            yield [(task, outcome)]

    def _carried_out(self, task: Task, watcher: Watcher, framework: Snapshot) -> tuple[Outcome | Failure, str]:
        """The outcome of a task, and what it printed to standard output."""
        with contextlib.redirect_stdout(io.StringIO()) as output:
            try:
                with _time_limit(self.limits.seconds):
                    outcome = attempt(task, watcher.preparing, framework)
            except StopUnitError:
                why = f"failed: it took longer than unit_timeout={self.limits.seconds:g} seconds"
                outcome = Failure(why=why + blamed(task.work.pair), lost=True)
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


class ProcessExecutor:
    """Carries out the tasks in worker processes of this machine.

    Args:
        workers: number of worker processes.
        limits: of each task.
    """

    def __init__(self, workers: int, limits: Limits) -> None:
        self.size, self.limits = workers, limits
        self.idle: list[Worker] = []

    def map(self, tasks: Iterable[Task], watcher: Watcher) -> Generator[list[Finished], None, None]:
        waiting, retries = iter(tasks), Retries()
        before = resident_bytes(os.getpid())
        busy: dict[Worker, Task] = {}
        told: list[Task] = []
        try:
            while True:
                ended: list[Finished] = []
                while len(busy) < self.size and (task := retries.next(waiting)) is not None:
                    content = packed(task)
                    if isinstance(content, Failure):
                        ended.append((task, content))
                        continue
                    worker = self.idle.pop() if self.idle else Worker(self.limits)
                    worker.give(content)
                    busy[worker] = task
                if ended:
                    yield ended
                    ended = []
                if not busy:
                    return
                if [*map(id, busy.values())] != [*map(id, told)]:
                    told = list(busy.values())
                    watcher.working([work for task in told for work in (task.work, *task.others)])
                wait([source for worker in busy for source in worker.sources], NEWS_S)
                self._check_own_memory(before)
                for worker in list(busy):
                    for item in worker.news():
                        if not isinstance(item, Outcome | Failure):
                            watcher.preparing(*item)
                            continue
                        task, lines = busy.pop(worker), worker.lines()
                        if worker.spent:
                            worker.close()
                        else:
                            self.idle.append(worker)
                        ended += retries.ended(task, item, lines, watcher)
                if ended:
                    yield ended
        finally:
            # Those still busy were stopped by the caller.
            for worker in busy:
                worker.close()

    def _check_own_memory(self, before: int) -> None:
        """Raise UserError if this process, which only keeps records, grew by more than a unit may use."""
        grown = (resident_bytes(os.getpid()) - before) / GB
        if self.limits.memory_gb and grown > self.limits.memory_gb:
            owners = " and ".join(holders(registry.foreign())) or "something that a plug-in left"
            raise UserError(
                f"the run is stopped, what is finished is kept: its own process grew by {grown:.1f} GB, more than "
                f"unit_memory={self.limits.memory_gb:.3g} GB, by {owners}; use the plug-in alone to see what it does"
            )

    def close(self) -> None:
        for worker in self.idle:
            worker.close()


class Retries:
    """Tries a task whose process died a second time, the units of a batch alone, and passes on the outcomes of all others."""

    def __init__(self) -> None:
        self._again: deque[Task] = deque()
        self._died: set[int] = set()

    def next(self, waiting: Iterator[Task]) -> Task | None:
        """The next task; None if there is none at the moment."""
        return self._again.popleft() if self._again else next(waiting, None)

    def put_back(self, task: Task) -> None:
        """A task that was interrupted by no fault of its own."""
        self._again.append(task)

    def ended(
        self, task: Task, outcome: Outcome | Failure, lines: Sequence[str], watcher: Watcher
    ) -> Iterator[Finished]:
        """The task with its outcome, unless it is tried again.

        Args:
            task: the task.
            outcome: its outcome.
            lines: what it printed.
            watcher: is told.
        """
        if isinstance(outcome, Failure) and (outcome.lost or outcome.tampered) and task.others:
            # Each unit of a batch alone says which one it was.
            self._again.extend(task.parts())
            return
        if isinstance(outcome, Failure) and outcome.died and id(task) not in self._died:
            self._died.add(id(task))
            self._again.append(task)
            return
        self._died.discard(id(task))
        if lines:
            watcher.printed(task.work, lines)
        if isinstance(outcome, Failure) and outcome.lost:
            outcome = replace(outcome, why=outcome.why + blamed(task.work.pair))
        yield task, outcome


def _ray(workers: int | None, limits: Limits, address: str) -> Executor:
    from cavbench.run.ray_executor import RayExecutor

    return RayExecutor(workers, limits, address)


EXECUTORS: dict[str, Callable[[int | None, Limits, str], Executor]] = {
    "serial": lambda workers, limits, address: SerialExecutor(limits),
    "processes": lambda workers, limits, address: ProcessExecutor(workers or cores(), limits),
    "ray": _ray,
}
"""Every back end by the name that `executor=` has on the command line.

Each is made with the number of workers (None: as many as there are cores), the limits, and the address of the Ray cluster.
"""
