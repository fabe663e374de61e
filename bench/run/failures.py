"""What failed in a run that went on: one line for each pair and reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from cavbench.core.pair import Pair
from cavbench.errors import UnfinishedError
from cavbench.run.task import Outcome, Task

ENOUGH = 2
"""A pair is given up when so many of its units hung, ended their process, or used up its memory."""


class TaskError(Exception):
    """The traceback of a failure in a worker, as the cause of an `UnfinishedError`."""


class Failures:
    """Collects failures.

    Args:
        broken: lines about plug-ins that were left out.
    """

    def __init__(self, broken: Iterable[str] = ()) -> None:
        self._broken = list(broken)
        self._first: dict[tuple[str, str], str] = {}
        self._units: Counter[tuple[str, str]] = Counter()
        self._lost: Counter[str] = Counter()
        self._left: Counter[str] = Counter()
        self._place: dict[str, tuple[str, str]] = {}
        self._trace = ""

    def add(self, task: Task, outcome: Outcome) -> str:
        """Note a task that failed, and return its line; empty if the pair failed for the same reason before."""
        key = task.pair.id, outcome.why
        line = "" if key in self._first else f"{task} {outcome.why}"
        self._first.setdefault(key, line)
        self._units[key] += 1
        self._place[task.pair.id] = key
        self._lost[task.pair.id] += outcome.lost
        self._trace = self._trace or outcome.trace
        return line

    def given_up(self, pair: Pair) -> bool:
        """Whether the rest of a pair is not worth the time."""
        return self._lost[pair.id] >= ENOUGH

    def leave(self, pair: Pair, units: int) -> None:
        """Note that units of a pair that was given up are not driven."""
        self._left[pair.id] += units

    def lines(self) -> list[str]:
        """One line for each plug-in that was left out, and for each pair and reason: the first unit, and how many more."""
        found = list(self._broken)
        for key, line in self._first.items():
            more = [f"the same in {count} more"] if (count := self._units[key] - 1) else []
            if key == self._place[key[0]] and (left := self._left[key[0]]):
                more.append(f"the pair was given up, {left} more were not driven")
            found.append(f"{line}; {', '.join(more)}" if more else line)
        return found

    def error(self, finished: Sequence[str], missing: int) -> UnfinishedError:
        """The error at the end of the run, with the traceback of the first failure as its cause."""
        error = UnfinishedError(self.lines(), finished, missing)
        error.__cause__ = TaskError(f"\n{self._trace}") if self._trace else None
        return error

    def __bool__(self) -> bool:
        return bool(self._broken or self._first)
