"""How long a run will still take: from what its parts should cost, corrected by what those that are done did cost.

Parts are compared with parts like them. A pair counts for itself; before one of its parts is done, pairs with the same defended
victim or the same attack do; then all. Within a batch the share of the steps counts, of those that such a batch usually drives:
one in which all episodes end early is done sooner.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Hashable, Sequence
from dataclasses import dataclass

from cavbench.core.pair import Pair
from cavbench.run.cost import longest, preparing_s, rates, shares
from cavbench.run.task import Task

EARLY = 0.02
"""Share of a batch, or of parts that are alike, from which on its time says something of the others."""
REST = 0.1
"""Share of the steps to come that a batch still drives when it is past its usual end."""


@dataclass
class Part:
    """A unit, or something that is prepared.

    Args:
        pair: its pair.
        cost: CPU seconds that it should take.
    """

    pair: Pair
    cost: float


@dataclass
class Batch:
    """What a worker carries out at once.

    Args:
        name: what it is called while it is under way.
        parts: the keys of its parts.
        pair: their pair.
        cost: CPU seconds that it should take.
        reach: share of the steps at which it usually ends.
        episodes: of the first part.
        started: when it began.
        share: share of its cost that is done.
        heard: when it was first heard of, and its share then: what was before prepared it, and says little of its pace.
    """

    name: str
    parts: tuple[str, ...]
    pair: Pair
    cost: float
    reach: float
    episodes: int
    started: float
    share: float = 0.0
    heard: tuple[float, float] | None = None


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
        self.parts: dict[str, Part] = {}
        self.spent: dict[Hashable, list[float]] = {}
        self.expect(tasks, recorded)
        self.running: dict[str, Batch] = {}
        self.ended: dict[str, Part] = {}

    def expect(self, tasks: Sequence[Task], recorded: Collection[str] = ()) -> None:
        """These tasks are still to be done, and no others; arguments as of the class."""
        costs = iter(shares([task.unit for task in tasks if task.step == "drive"], self.workers, recorded))
        self.parts = {
            _key(task): Part(task.pair, next(costs) if task.step == "drive" else preparing_s(task.unit))
            for task in tasks
        }
        self.costs = {alike: expected for alike, (_, expected) in self.spent.items()}
        for part in self.parts.values():
            for alike in _alike(part.pair):
                self.costs[alike] = self.costs.get(alike, 0.0) + part.cost

    def working(self, tasks: Sequence[Task]) -> None:
        """These are under way, each with all its units, and no others."""
        running: dict[str, Batch] = {}
        for task in tasks:
            keys = tuple(_key(one) for one in task.each)
            known = self.running.get(keys[0])
            # The units of a batch that was lost are tried alone.
            running[keys[0]] = known if known and known.parts == keys else self._begun(task, keys)
        self.running = running

    def _begun(self, task: Task, keys: tuple[str, ...]) -> Batch:
        known, drives, episodes = rates(task.pair), task.step == "drive", [len(unit.seeds) for unit in task.units]
        cost = known.of(sum(episodes)) if drives else preparing_s(task.unit)
        for key, count in zip(keys, episodes, strict=True):
            self.parts[key] = Part(task.pair, cost * count / sum(episodes))
        return Batch(
            str(task),
            keys,
            task.pair,
            cost,
            longest(known.length, sum(episodes)) if drives else 1.0,
            episodes[0],
            self.now(),
        )

    def reached(self, name: str, share: float, episodes: int = 0) -> None:
        """So much is done of what is called so; with more episodes than its first part has, of all in one batch with it."""
        for batch in self.running.values():
            if batch.name != name:
                continue
            # Past its usual end, there is always some left.
            share /= max(batch.reach, REST + (1 - REST) * share)
            if len(batch.parts) > 1 and episodes <= batch.episodes:
                share /= len(batch.parts)
            batch.share = max(batch.share, min(share, 1.0))
            batch.heard = batch.heard or (self.now(), batch.share)

    def finished(self, task: Task, seconds: float) -> None:
        """A task of a unit is done; it took so many seconds of a worker."""
        key = _key(task)
        # The parts of a batch are told of one after the other, but are done at the same time.
        for batch in [batch for batch in self.running.values() if key in batch.parts]:
            del self.running[batch.parts[0]]
            self.ended |= {one: self.parts.pop(one) for one in batch.parts if one in self.parts}
        if part := self.ended.pop(key, None) or self.parts.pop(key, None):
            for alike in _alike(part.pair):
                spent = self.spent.setdefault(alike, [0.0, 0.0])
                spent[0], spent[1] = spent[0] + seconds, spent[1] + part.cost

    @property
    def left(self) -> float:
        """Seconds until the run is done."""
        batches = [batch.cost * (1 - batch.share) * self._factor_of(batch) for batch in self.running.values()]
        busy = {key for batch in self.running.values() for key in batch.parts}
        by_pair: dict[str, list[Part]] = {}
        for key, part in self.parts.items():
            if key not in busy:
                by_pair.setdefault(part.pair.id, []).append(part)
        waiting = sum(sum(part.cost for part in parts) * self._factor(parts[0].pair) for parts in by_pair.values())
        return max((waiting + sum(batches)) / self.workers, *batches, 0.0)

    def _pace(self, batch: Batch) -> float:
        """How many times as long as expected a batch that is under way takes; 0 if that cannot be told yet."""
        if batch.share <= EARLY or not batch.cost:
            return 0.0
        since, share = batch.heard or (batch.started, 0.0)
        if batch.share - share <= EARLY:
            since, share = batch.started, 0.0
        return (self.now() - since) / (batch.cost * (batch.share - share))

    def _factor_of(self, batch: Batch) -> float:
        return self._pace(batch) or self._factor(batch.pair)

    def _factor(self, pair: Pair) -> float:
        """How many times as long as expected parts like those of a pair take."""
        for key in _alike(pair):
            seconds, expected = self.spent.get(key, (0.0, 0.0))
            # A thousandth of a second that took a tenth says nothing of an hour.
            if expected > EARLY * self.costs.get(key, 0.0):
                return seconds / expected
        # Nothing is done yet: what is under way says the same.
        known = [pace for batch in self.running.values() if (pace := self._pace(batch))]
        return sum(known) / len(known) if known else 1.0


def _key(task: Task) -> str:
    """What a task of a unit is found by again."""
    return task.unit.fingerprint if task.step == "drive" else task.unit.artefact


def _alike(pair: Pair) -> tuple[Hashable, ...]:
    """What parts of pairs have in common, the closest first."""
    return (pair.id, ("defended", pair.defended, pair.is_clean), ("attack", str(pair.attack)), "all")
