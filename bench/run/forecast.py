"""How long a run will still take: from what its parts should cost, corrected by what those that are done did cost.

Parts are compared with parts like them. A pair counts for itself; before one of its parts is done, pairs with the same defended
victim or the same attack do; then all.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Hashable, Sequence
from dataclasses import dataclass

from cavbench.core.pair import Pair
from cavbench.run.cost import rates, shares
from cavbench.run.task import Task

EARLY = 0.02
"""Share of a batch from which on its time says something of it."""


@dataclass
class Part:
    """A unit, or something that is prepared.

    Args:
        name: what it is called while it is under way.
        pair: its pair.
        group: what units of one batch have in common.
        cost: CPU seconds that it should take.
        episodes: of a unit.
        share: share that is done.
        started: when it began; NaN before.
    """

    name: str
    pair: Pair
    group: Hashable
    cost: float
    episodes: int
    share: float = 0.0
    started: float = math.nan

    @property
    def left(self) -> float:
        """CPU seconds that are left of it."""
        return self.cost * (1 - self.share)


class Forecast:
    """The seconds that are left of a run.

    Args:
        tasks: what is to be done: a task for each unit, and for what is prepared.
        workers: number of tasks that are carried out at once.
        now: a clock in seconds.
        recorded: fingerprints of the units that are recorded.
    """

    def __init__(
        self,
        tasks: Sequence[Task],
        workers: int,
        now: Callable[[], float] = time.monotonic,
        recorded: Collection[str] = (),
    ) -> None:
        self.workers, self.now = workers, now
        units = [task.unit for task in tasks if task.step == "drive"]
        costs = iter(shares(units, workers, recorded))
        self.parts: dict[str, Part] = {}
        for task in tasks:
            pair, group = task.pair, (task.step, task.pair.id, task.unit.training_seed)
            cost = next(costs) if task.step == "drive" else rates(pair).artefact
            self.parts[_key(task)] = Part(str(task), pair, group, cost, len(task.unit.seeds))
        self.running: dict[str, Part] = {}
        self.spent: dict[Hashable, list[float]] = {}

    def working(self, tasks: Sequence[Task]) -> None:
        """These are under way."""
        for task in tasks:
            if (part := self.parts.get(key := _key(task))) and math.isnan(part.started):
                part.started = self.now()
                self.running[key] = part

    def reached(self, name: str, share: float, episodes: int = 0) -> None:
        """So much is done of what is called so; with more episodes than its own, of all that is in one batch with it."""
        for parts in self._under_way().values():
            named = [part for part in parts if part.name == name]
            together = bool(named) and episodes > named[0].episodes
            for part in parts if together else named:
                part.share = max(part.share, min(share, 1.0))

    def finished(self, task: Task, seconds: float) -> None:
        """A task of a unit is done; it took so many seconds of a worker."""
        if part := self.parts.pop(_key(task), None):
            self.running.pop(_key(task), None)
            for key in _alike(part.pair):
                spent = self.spent.setdefault(key, [0.0, 0.0])
                spent[0], spent[1] = spent[0] + seconds, spent[1] + part.cost

    @property
    def left(self) -> float:
        """Seconds until the run is done."""
        under_way = self._under_way()
        factors = {key: self._factor_of(parts) or self._factor(parts[0].pair) for key, parts in under_way.items()}
        batches = [sum(part.left for part in parts) * factors[key] for key, parts in under_way.items()]
        by_pair: dict[str, list[Part]] = {}
        for part in self.parts.values():
            if math.isnan(part.started):
                by_pair.setdefault(part.pair.id, []).append(part)
        waiting = sum(sum(part.cost for part in parts) * self._factor(parts[0].pair) for parts in by_pair.values())
        return max((waiting + sum(batches)) / self.workers, *batches, 0.0)

    def _under_way(self) -> dict[Hashable, list[Part]]:
        found: dict[Hashable, list[Part]] = {}
        for part in self.running.values():
            found.setdefault((part.group, part.started), []).append(part)
        return found

    def _factor_of(self, parts: Sequence[Part]) -> float:
        """How many times as long as expected a batch that is under way takes; 0 if that cannot be told yet."""
        done, expected = sum(part.cost * part.share for part in parts), sum(part.cost for part in parts)
        return (self.now() - parts[0].started) / done if done > EARLY * expected else 0.0

    def _factor(self, pair: Pair) -> float:
        """How many times as long as expected parts like those of a pair take."""
        for key in _alike(pair):
            seconds, expected = self.spent.get(key, (0.0, 0.0))
            if expected:
                return seconds / expected
        # Nothing is done yet: what is under way says the same.
        known = [factor for parts in self._under_way().values() if (factor := self._factor_of(parts))]
        return sum(known) / len(known) if known else 1.0


def _key(task: Task) -> str:
    """What a task of a unit is found by again."""
    return task.unit.fingerprint if task.step == "drive" else task.unit.artefact


def _alike(pair: Pair) -> tuple[Hashable, ...]:
    """What parts of pairs have in common, the closest first."""
    return (pair.id, ("defended", pair.defended, pair.is_clean), ("attack", str(pair.attack)), "all")
