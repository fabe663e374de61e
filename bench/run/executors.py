"""Back ends that carry out tasks: `map(tasks)` yields each outcome as soon as it is finished, in any order."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.queues import SimpleQueue
from typing import Protocol

from bench.errors import UserError
from bench.run.process import settle
from bench.run.unit import Preparation, Unit
from bench.run.work import Outcome, Task, Tell, perform

NEWS_S = 1.0
"""Seconds between two updates of the tasks' progress."""
Finished = tuple[Task, Outcome]


class Watcher(Protocol):
    """Receives the progress of the work; the command line draws a progress bar."""

    def working(self, works: Sequence[Unit | Preparation]) -> None:
        """Called with the work in progress."""

    def preparing(self, work: str, share: float, text: str) -> None:
        """Called with the share of a preparation done in [0, 1], and a text of the attack."""


class Executor(Protocol):
    """A back end that carries out tasks."""

    def map(self, tasks: Sequence[Task], watcher: Watcher) -> Generator[Finished, None, None]:
        """Carry out all tasks, and yield each with its outcome as soon as it is finished.

        Closing the generator stops the tasks in progress.

        Raises:
            UserError: if a task fails or a worker dies.
        """
        ...


class SerialExecutor:
    """Carries out the tasks in this process, one after the other."""

    def map(self, tasks: Sequence[Task], watcher: Watcher) -> Generator[Finished, None, None]:
        settle()
        for task in tasks:
            watcher.working([task.work])
            yield task, perform(task, watcher.preparing)


class ProcessExecutor:
    """Carries out the tasks in worker processes of this machine.

    Args:
        workers: number of worker processes.
    """

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def map(self, tasks: Sequence[Task], watcher: Watcher) -> Generator[Finished, None, None]:
        if not tasks:
            return
        others = set(multiprocessing.active_children())
        context = multiprocessing.get_context("spawn")
        news: SimpleQueue[tuple[str, float, str]] = context.SimpleQueue()
        workers = min(self.workers, len(tasks))
        pool = ProcessPoolExecutor(workers, context, initializer=_begin_work, initargs=(news,))
        try:
            yield from _pooled(pool, tasks, workers, watcher, news)
        except BrokenProcessPool:
            raise UserError(
                "a worker process died (killed, or out of memory); "
                "finished units are kept: run the same command again to continue"
            ) from None
        except BaseException:
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
            raise
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _pooled(
    pool: ProcessPoolExecutor,
    tasks: Sequence[Task],
    workers: int,
    watcher: Watcher,
    news: SimpleQueue[tuple[str, float, str]],
) -> Iterator[Finished]:
    """Submit only as many tasks as there are workers, so that all submitted tasks are in progress."""
    waiting = list(reversed(tasks))
    running: dict[Future[Outcome], Task] = {}
    while waiting or running:
        while waiting and len(running) < workers:
            task = waiting.pop()
            running[pool.submit(_perform, task)] = task
        watcher.working([task.work for task in running.values()])
        finished = wait(running, NEWS_S, FIRST_COMPLETED).done
        while not news.empty():
            watcher.preparing(*news.get())
        for future in finished:
            yield running.pop(future), future.result()


EXECUTORS: dict[str, Callable[[int], Executor]] = {
    "serial": lambda workers: SerialExecutor(),
    "processes": ProcessExecutor,
}
"""Every back end by the name that `executor=` has on the command line; made with the number of workers."""


def executor(name: str, workers: int, tasks: int) -> Executor:
    """The back end of a name, for so many workers and tasks; `processes` is this process where one worker is enough."""
    one = name == "processes" and min(workers, tasks) <= 1
    return EXECUTORS["serial" if one else name](workers)


_tell: Tell
"""In a worker process, reports the progress of its work."""


def _begin_work(news: SimpleQueue[tuple[str, float, str]]) -> None:
    """Set up a worker process: one thread, ignores Ctrl-C (the parent stops it), exits when the parent is gone."""
    global _tell

    def tell(work: str, share: float, text: str) -> None:
        news.put((work, share, text))

    _tell = tell
    settle()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _perform(task: Task) -> Outcome:
    return perform(task, _tell)
