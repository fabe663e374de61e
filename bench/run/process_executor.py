"""Carries out tasks in worker processes of this machine."""

from __future__ import annotations

import os
from collections.abc import Generator, Iterable
from multiprocessing.connection import wait

from cavbench.core import registry
from cavbench.errors import UserError
from cavbench.isolation.threads import holders
from cavbench.isolation.tree import resident_bytes
from cavbench.run.executor import NEWS_S, Finished, Retries, Watcher
from cavbench.run.task import Limits, Outcome, Task
from cavbench.run.worker import GB, Worker, packed


class ProcessExecutor:
    """Carries out the tasks in worker processes of this machine.

    Args:
        workers: number of worker processes.
        limits: of each task.
    """

    beside = True

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
                    if isinstance(content, Outcome):
                        ended.append((task, content))
                        continue
                    worker = self.idle.pop() if self.idle else Worker(self.limits)
                    worker.give(content, task)
                    busy[worker] = task
                if ended:
                    yield ended
                    ended = []
                if not busy:
                    return
                if [*map(id, busy.values())] != [*map(id, told)]:
                    told = list(busy.values())
                    watcher.working(told)
                wait([source for worker in busy for source in worker.sources], NEWS_S)
                self._check_own_memory(before)
                for worker in list(busy):
                    for item in worker.news():
                        if not isinstance(item, Outcome):
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
