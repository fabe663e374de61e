"""Carries out a plan: passes its units to an executor as tasks, and writes the outcomes to files.

Artefacts (patches) are made first and kept as files for their units. A unit is a pure function of its configuration: results
do not depend on the executor, the number of workers or the order of tasks.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from typing import Protocol

from cavbench.run import config_file
from cavbench.run.batches import batches
from cavbench.run.cost import rates
from cavbench.run.executor import Executor, Finished
from cavbench.run.executors import EXECUTORS
from cavbench.run.failures import Failures
from cavbench.run.forecast import Forecast
from cavbench.run.loading import LoadWatcher, load
from cavbench.run.plan import Plan
from cavbench.run.racing import dearest, race
from cavbench.run.results import Results
from cavbench.run.rounds import drive_until
from cavbench.run.task import Outcome, Task
from cavbench.run.unit import Unit


class RunWatcher(LoadWatcher, Protocol):
    """Receives the progress of a run."""

    def begin(self, *, episodes: int, finished: int, forecast: Forecast) -> None:
        """The run has `episodes` in total, of which `finished` already have records; `forecast` says what the others take.

        Raises:
            UserError: if they shall not be driven.
        """

    def finished(self, task: Task, wall_s: float) -> None:
        """A task of one unit is finished and its outcome written; it took `wall_s` seconds."""


Choice = Callable[[Mapping[str, Unit]], Collection[str]]
"""Chooses some of a run's units, given by their fingerprints, when their networks are loaded."""


def run(plan: Plan, watcher: RunWatcher, choose: Choice | None = None) -> list[str]:
    """Drive the unfinished units of a plan, and return the fingerprints of its units; with `until`, of those it needed.

    Args:
        plan: the run.
        watcher: is told what happens.
        choose: leaves out some of the units; not with `until`.

    Raises:
        UserError: if the results folder cannot be written, weights are missing, or no pair can be driven.
        UnfinishedError: at the end, if a component failed or a worker died; all other units are finished.
    """
    failures = Failures(plan.broken)
    results = Results(plan.out)
    if plan.words:
        config_file.write(plan.out, plan.words)
    for line in plan.broken:
        watcher.failed(line)
    with closing(EXECUTORS[plan.executor](plan)) as back_end:
        weights = load(plan, back_end, watcher, failures)
        units = {unit.fingerprint: unit for part in plan.rounds for unit in part.units(weights)}
        if choose is not None:
            chosen = choose(units)
            units = {key: unit for key, unit in units.items() if key in chosen}
        driving = _Driving(results, plan.recorded(units.values()), back_end, watcher, failures)
        driving.finished |= results.finished(units)
        expected = dearest(plan, list(units.values()), lambda pair: rates(pair).episode)
        done = sum(len(unit.seeds) for unit in expected if unit.fingerprint in driving.finished)
        forecast = driving.forecast(expected)
        watcher.begin(episodes=sum(len(unit.seeds) for unit in expected), finished=done, forecast=forecast)
        if plan.until is not None:
            wanted = drive_until(plan, weights, driving.carry_out, results)
        elif plan.racing:
            wanted = race(plan, list(units.values()), driving.carry_out, driving.rest, results)
        else:
            driving.carry_out(expected)
            wanted = list(units)
    if line := _hopeless(plan, {key: unit for key, unit in units.items() if key in driving.finished}, results):
        watcher.warn(line)
    if failures:
        finished = [key for key in wanted if key in driving.finished]
        raise failures.error(finished, len(wanted) - len(finished))
    return wanted


def _hopeless(plan: Plan, finished: Mapping[str, Unit], results: Results) -> str:
    """What the track says if all baselines of a run fail in all their episodes; empty otherwise."""
    names = {pair.id for pair in plan.baselines} - {pair.id for pair in plan.pairs}
    own = [key for key, unit in finished.items() if unit.pair.id in names]
    if not own:
        return ""
    records = results.records(own, plan.track)
    return plan.track.hopeless(records)


class _Driving:
    """Passes units to an executor, and writes each outcome as soon as it is there.

    Args:
        results: the results folder.
        recorded: the scenario seeds to record, by fingerprint of the unit.
        back_end: the executor.
        watcher: is told what happens.
        failures: collects what failed.
    """

    def __init__(
        self,
        results: Results,
        recorded: Mapping[str, Sequence[int]],
        back_end: Executor,
        watcher: RunWatcher,
        failures: Failures,
    ) -> None:
        self.results, self.recorded, self.back_end = results, recorded, back_end
        self.watcher, self.failures = watcher, failures
        self.finished: set[str] = set()
        self._forecast: Forecast | None = None
        self._warned: set[str] = set()

    def forecast(self, units: Sequence[Unit]) -> Forecast:
        """What the units that are not finished take, with what is prepared for them."""
        self._forecast = Forecast(self._tasks(units), self.back_end.size, recorded=self.recorded)
        return self._forecast

    def rest(self, units: Sequence[Unit]) -> set[str]:
        """As `carry_out`, of units that are all that is left of the run."""
        if self._forecast:
            self._forecast.expect(self._tasks(units), self.recorded)
        return self.carry_out(units)

    def _tasks(self, units: Sequence[Unit]) -> list[Task]:
        waiting = [unit for unit in units if unit.fingerprint not in self.finished]
        absent = {unit.artefact: Task(unit=unit, step="prepare") for unit in waiting if self.results.lacks(unit)}
        return [*absent.values(), *(Task(unit=unit) for unit in waiting)]

    def carry_out(self, units: Sequence[Unit]) -> set[str]:
        """Prepare what is missing, drive the units that are not finished, and return the fingerprints of those that are now."""
        absent: dict[str, Task] = {}
        ready: list[Unit] = []
        waits: list[Unit] = []
        for unit in (unit for unit in units if unit.fingerprint not in self.finished):
            if self.results.lacks(unit):
                absent[unit.artefact] = Task(unit=unit, step="prepare")
            (waits if unit.artefact in absent else ready).append(unit)
        for first, then in ((absent.values(), ready), ((), waits)):
            tasks = [*first, *(Task(unit=unit) for unit in sorted(then, key=_longest_first))]
            together = batches(tasks, self.recorded, self.back_end.size)
            with closing(self.back_end.map(self._complete(together), self.watcher)) as finished:
                for some in finished:
                    self._end(some)
        return self.finished

    def _complete(self, together: Iterable[Sequence[Task]]) -> Iterator[Task]:
        """The tasks of batches with all that they need.

        Left out are the units of a pair that was given up, and those whose preparation failed.
        """
        for batch in together:
            units: list[Unit] = []
            for task in batch:
                if self.failures.given_up(task.pair):
                    self.failures.leave(task.pair, 1)
                elif task.step == "prepare":
                    yield task
                elif not self.results.lacks(task.unit):
                    units.append(task.unit)
            if units:
                first, *others = units
                recorded = self.recorded.get(first.fingerprint, ())
                yield Task(unit=first, artefacts=self.results.artefacts(units), recorded=recorded, others=others)

    def _end(self, some: Iterable[Finished]) -> None:
        """Write the outcomes of tasks that finished at about the same time, then tell the watcher."""
        kept: list[tuple[Task, Outcome]] = []
        for task, outcome in some:
            # A batch may fail as a whole: then none of its units has an outcome of its own.
            others = outcome.others or [outcome] * len(task.others)
            for one, own in zip(task.each, (outcome, *others), strict=True):
                if not own.failed:
                    kept.append((one, own))
                elif line := self.failures.add(one, own):
                    self.watcher.failed(line)
        self.results.keep(kept)
        for one, own in kept:
            if one.step == "drive":
                self.finished.add(one.unit.fingerprint)
            self.watcher.finished(one, own.wall_s)
            for warning in own.warnings:
                if warning not in self._warned:
                    self._warned.add(warning)
                    self.watcher.warn(warning)


def _longest_first(unit: Unit) -> tuple[object, ...]:
    """Sort key: block after block; in each, attacked units first, then those with the highest values on their axes.

    So no long unit comes last, and a run that ends early has complete blocks.
    """
    numbers = [-value for value in unit.cell.values() if not isinstance(value, str)]
    return (unit.seeds.start, unit.pair.is_clean, *reversed(numbers))
