"""What a back end that carries out tasks is: `map(tasks)` yields the outcomes as soon as they are finished, in any order."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Protocol

from cavbench.run.blame import blamed
from cavbench.run.task import Outcome, Task

NEWS_S = 1.0
"""Seconds between two looks at the workers' time and memory."""
Finished = tuple[Task, Outcome]


class Watcher(Protocol):
    """Receives the progress of tasks; the command line draws a progress bar."""

    def working(self, tasks: Sequence[Task]) -> None:
        """Called with the tasks in progress, each with all its units."""

    def preparing(self, task: str, share: float, text: str, episodes: int = 0) -> None:
        """Called with the share of a task done in [0, 1]; of a preparation with a text, of units with their episodes."""

    def printed(self, task: Task, lines: Sequence[str]) -> None:
        """Called with what the components printed during a task."""


class Executor(Protocol):
    """A back end that carries out tasks.

    `size` is the number of tasks that it carries out at once, `beside` whether in processes of this machine beside this one.
    """

    size: int
    beside: bool

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

    def ended(self, task: Task, outcome: Outcome, lines: Sequence[str], watcher: Watcher) -> Iterator[Finished]:
        """The task with its outcome, unless it is tried again.

        Args:
            task: the task.
            outcome: its outcome.
            lines: what it printed.
            watcher: is told.
        """
        if (outcome.lost or outcome.tampered) and task.others:
            # Each unit of a batch alone says which one it was.
            self._again.extend(task.each)
            return
        if outcome.died and id(task) not in self._died:
            self._died.add(id(task))
            self._again.append(task)
            return
        self._died.discard(id(task))
        if lines:
            watcher.printed(task, lines)
        if outcome.lost:
            outcome = replace(outcome, why=outcome.why + blamed(task.pair))
        yield task, outcome
