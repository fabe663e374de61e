"""Back ends that carry out tasks: `map(tasks)` yields each outcome as soon as it is finished, in any order."""

from __future__ import annotations

import contextlib
import io
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import wait
from types import FrameType
from typing import Protocol

from bench.plugins.foreign import StopUnitError
from bench.plugins.framework import Snapshot
from bench.run.blame import blamed
from bench.run.process import settle
from bench.run.unit import Loading, Preparation, Unit
from bench.run.work import Failure, Outcome, Task, attempt
from bench.run.worker import Limits, Worker

NEWS_S = 1.0
"""Seconds between two looks at the workers' time and memory."""
Finished = tuple[Task, Outcome | Failure]


class Watcher(Protocol):
    """Receives the progress of the work; the command line draws a progress bar."""

    def working(self, works: Sequence[Unit | Preparation | Loading]) -> None:
        """Called with the work in progress."""

    def preparing(self, work: str, share: float, text: str) -> None:
        """Called with the share of a preparation done in [0, 1], and a text of the attack."""

    def printed(self, work: Unit | Preparation | Loading, lines: Sequence[str]) -> None:
        """Called with what the components printed while they worked."""


class Executor(Protocol):
    """A back end that carries out tasks."""

    def map(self, tasks: Iterable[Task], watcher: Watcher) -> Generator[Finished, None, None]:
        """Carry out all tasks, and yield each with its outcome, or why it failed, as soon as it is finished.

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

    def __init__(self, limits: Limits) -> None:
        self.limits = limits

    def map(self, tasks: Iterable[Task], watcher: Watcher) -> Generator[Finished, None, None]:
        settle()
        framework, culprit = Snapshot(), ""
        for task in tasks:
            if culprit:
                yield task, Failure(why=f"was not driven: {culprit} changed this process; use executor=processes")
                continue
            watcher.working([task.work])
            outcome, text = self._carried_out(task, watcher, framework)
            if lines := [line for line in text.splitlines() if line.strip()]:
                watcher.printed(task.work, lines)
            if isinstance(outcome, Failure) and outcome.tampered:
                culprit = str(task.work)
            yield task, outcome

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
    if not seconds or threading.current_thread() is not threading.main_thread():
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
        self.count, self.limits = workers, limits
        self.workers: list[Worker] = []

    def map(self, tasks: Iterable[Task], watcher: Watcher) -> Generator[Finished, None, None]:
        waiting, again = iter(tasks), deque[Task]()
        died: set[int] = set()
        try:
            while True:
                yield from self._give(waiting, again)
                busy = [worker for worker in self.workers if worker.task is not None]
                if not busy:
                    return
                watcher.working([worker.task.work for worker in busy if worker.task is not None])
                wait([item for worker in busy for item in (worker.connection, worker.process.sentinel)], NEWS_S)
                for worker in busy:
                    for task, outcome in self._news(worker, watcher):
                        if isinstance(outcome, Failure) and outcome.died and id(task) not in died:
                            died.add(id(task))
                            again.append(task)
                        else:
                            died.discard(id(task))
                            yield task, outcome
        finally:
            # A worker that is still busy was stopped by the caller.
            self._dismiss(worker for worker in list(self.workers) if worker.task is not None)

    def _give(self, waiting: Iterator[Task], again: deque[Task]) -> Iterator[Finished]:
        """Give every idle worker a task, and start workers as long as there are tasks."""
        while len([worker for worker in self.workers if worker.task is not None]) < self.count:
            task = again.popleft() if again else next(waiting, None)
            if task is None:
                return
            idle = next((worker for worker in self.workers if worker.task is None), None)
            if idle is None:
                idle = Worker(self.limits)
                self.workers.append(idle)
            if failure := idle.give(task):
                yield task, failure

    def _news(self, worker: Worker, watcher: Watcher) -> Iterator[Finished]:
        """Pass on a worker's news; the outcome of its task if it has one."""
        task = worker.task
        assert task is not None
        for item in worker.news():
            if not isinstance(item, Outcome | Failure):
                watcher.preparing(*item)
                continue
            if lines := worker.lines():
                watcher.printed(task.work, lines)
            if not worker.alive or (isinstance(item, Failure) and item.tampered):
                self._dismiss([worker])
            yield task, item

    def _dismiss(self, workers: Iterable[Worker]) -> None:
        for worker in workers:
            self.workers.remove(worker)
            worker.close()

    def close(self) -> None:
        self._dismiss(list(self.workers))


EXECUTORS: dict[str, Callable[[int, Limits], Executor]] = {
    "serial": lambda workers, limits: SerialExecutor(limits),
    "processes": ProcessExecutor,
}
"""Every back end by the name that `executor=` has on the command line; made with the number of workers and the limits."""
