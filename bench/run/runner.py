"""Carries out a run: passes its units of work to an executor, and writes the outcomes to files.

Finished units are packed as the run goes on (`cavbench.records.packing`).

Preparations (patches) are made first and kept as files for their units. A unit is a pure function of its configuration: results
do not depend on the executor, the number of workers or the order of work.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Protocol

import pyarrow as pa

from cavbench import files
from cavbench.core.track import Track
from cavbench.errors import RefusedNetworkError, UserError, message
from cavbench.records import packing, store
from cavbench.records.finished import finished as finished_units
from cavbench.run import artefacts
from cavbench.run.baselines import hopeless
from cavbench.run.batches import batches
from cavbench.run.config import RunConfig
from cavbench.run.executors import EXECUTORS, Executor, Finished, Watcher
from cavbench.run.failures import Failures
from cavbench.run.plan import Weights, key_of, loadings, units_of
from cavbench.run.rounds import drive_until, rounds
from cavbench.run.unit import Loading, Preparation, Unit, is_foreign
from cavbench.run.work import Outcome, Task
from cavbench.run.worker import Limits
from cavbench.scenarios import Cell
from cavbench.scenarios.axes import written


class RunWatcher(Watcher, Protocol):
    """Receives the progress of a run."""

    def begin(self, *, episodes: int, finished: int) -> None:
        """The run has `episodes` in total, of which `finished` already have records."""

    def finished(self, work: Unit | Preparation, wall_s: float) -> None:
        """A unit or preparation is finished and written; it took `wall_s` seconds."""

    def failed(self, line: str) -> None:
        """A unit, preparation or loading failed; the run goes on."""

    def warn(self, line: str) -> None:
        """Something went wrong that does not affect the records."""


Choice = Callable[[Mapping[str, Unit]], Collection[str]]
"""Chooses some of a run's units, given by their fingerprints, when their networks are loaded."""


def run(config: RunConfig, watcher: RunWatcher, choose: Choice | None = None) -> list[str]:
    """Carry out the unfinished units of a run, and return the fingerprints of its units; with `until`, of those it needed.

    Args:
        config: the run.
        watcher: is told what happens.
        choose: leaves out some of the units; not with `until`.

    Raises:
        UserError: if the results folder cannot be written, weights are missing, or no pair can be driven.
        UnfinishedError: at the end, if a component failed or a worker died; all other units are finished.
    """
    store.prepare(config.out)
    failures = Failures(config.broken)
    for line in config.broken:
        watcher.failed(line)
    limits = Limits(seconds=config.unit_timeout, memory_gb=config.unit_memory)
    with closing(EXECUTORS[config.executor](config.workers, limits, config.ray_address)) as back_end:
        weights = _loaded(config, back_end, watcher, failures)
        if not any(key_of(loading) in weights for loading in loadings(config, baselines=False)):
            raise failures.error((), 0)
        units = {unit.fingerprint: unit for part in rounds(config) for unit in units_of(part, weights)}
        if choose is not None:
            chosen = choose(units)
            units = {key: unit for key, unit in units.items() if key in chosen}
        driving = _Driving(config.out, _recorded(config, units.values()), back_end, watcher, failures)
        driving.finished |= finished_units(config.out, units)
        packing.pack(config.out)
        episodes = {key: len(unit.seeds) for key, unit in units.items()}
        done = sum(episodes[key] for key in driving.finished)
        watcher.begin(episodes=sum(episodes.values()), finished=done)
        if config.until is None:
            driving.carry_out(list(units.values()))
            wanted = list(units)
        else:
            wanted = drive_until(config, weights, driving.carry_out)
    if line := hopeless(config, units.values(), driving.finished):
        watcher.warn(line)
    if failures:
        finished = [key for key in wanted if key in driving.finished]
        raise failures.error(finished, len(wanted) - len(finished))
    return wanted


def _loaded(config: RunConfig, back_end: Executor, watcher: RunWatcher, failures: Failures) -> Weights:
    """The hashes of the networks. Built-in components are loaded here, plug-ins where they are driven.

    What makes the scores doubtful is said before anything is driven.

    Raises:
        UserError: if a network is missing.
    """
    weights: dict[str, tuple[str, str]] = {}
    doubts: dict[str, None] = {}
    foreign = []
    for loading in loadings(config):
        if any(is_foreign(part) for part in loading.pair.parts):
            foreign.append(Task(work=loading))
        else:
            try:
                weights[key_of(loading)], found = loading.tried()
            except RefusedNetworkError as error:
                raise UserError(f"{loading} is refused: {message(error)}") from error
            doubts |= dict.fromkeys(found)
    with closing(back_end.map(foreign, watcher)) as finished:
        for task, outcome in chain.from_iterable(finished):
            assert isinstance(task.work, Loading)
            if isinstance(outcome, Outcome):
                assert outcome.weights is not None
                weights[key_of(task.work)] = outcome.weights
                doubts |= dict.fromkeys(outcome.warnings)
            elif outcome.bad_input:
                raise UserError(f"{task.work} {outcome.why}")
            elif line := failures.add(task.work, outcome):
                watcher.failed(line)
    for line in doubts:
        watcher.warn(line)
    return weights


class _Driving:
    """Passes work to an executor, and writes each outcome as soon as it is finished.

    Args:
        out: results folder.
        recorded: the scenario seeds to record, by fingerprint of the unit.
        back_end: the executor.
        watcher: is told what happens.
        failures: collects what failed.
    """

    def __init__(
        self,
        out: Path,
        recorded: Mapping[str, Sequence[int]],
        back_end: Executor,
        watcher: RunWatcher,
        failures: Failures,
    ) -> None:
        self.out, self.recorded, self.back_end, self.watcher, self.failures = out, recorded, back_end, watcher, failures
        self.finished: set[str] = set()
        self.unpacked = 0
        self._warned: set[str] = set()
        self._read = cache(artefacts.read)

    def carry_out(self, units: Sequence[Unit]) -> set[str]:
        """Prepare what is missing, drive the units that are not finished, and return the fingerprints of those that are now."""
        absent: dict[str, Preparation] = {}
        ready: list[Unit] = []
        waits: list[Unit] = []
        for unit in (unit for unit in units if unit.fingerprint not in self.finished):
            needed = unit.preparation
            if needed and not artefacts.path_of(self.out, needed).exists():
                absent[needed.fingerprint] = needed
            (waits if needed and needed.fingerprint in absent else ready).append(unit)
        first: list[Preparation | Unit] = [*absent.values(), *sorted(ready, key=_longest_first)]
        for works in (first, sorted(waits, key=_longest_first)):
            together = batches(works, self.recorded, self.back_end.size)
            with closing(self.back_end.map(self._tasks(together), self.watcher)) as finished:
                for some in finished:
                    self._end(some)
        return self.finished

    def _tasks(self, together: Iterable[Sequence[Preparation | Unit]]) -> Iterator[Task]:
        """The tasks of batches, without the units of a pair that was given up, and without those whose preparation failed."""
        for batch in together:
            units: list[Unit] = []
            prepared: dict[str, bytes] = {}
            for work in batch:
                if self.failures.given_up(work.pair):
                    self.failures.leave(work.pair, 1)
                elif isinstance(work, Preparation):
                    yield Task(work=work)
                elif work.preparation is None:
                    units.append(work)
                elif (path := artefacts.path_of(self.out, work.preparation)).exists():
                    units.append(work)
                    prepared[work.artefact] = self._read(path)
            if units:
                first, *others = units
                recorded = self.recorded.get(first.fingerprint, ())
                yield Task(work=first, artefacts=prepared, recorded=recorded, others=others)

    def _end(self, some: Iterable[Finished]) -> None:
        """Write the outcomes of tasks that finished at about the same time, then tell the watcher."""
        kept: list[tuple[Unit | Preparation, Outcome]] = []
        for task, outcome in some:
            # A batch may fail as a whole: then none of its units has an outcome of its own.
            others = outcome.others or [outcome] * len(task.others)
            for work, one in zip((task.work, *task.others), (outcome, *others), strict=True):
                assert not isinstance(work, Loading)
                if isinstance(one, Outcome):
                    kept.append((work, one))
                elif line := self.failures.add(work, one):
                    self.watcher.failed(line)
        self._keep(kept)
        for work, one in kept:
            self.finished.add(work.fingerprint)
            self.watcher.finished(work, one.wall_s)
            for warning in one.warnings:
                if warning not in self._warned:
                    self._warned.add(warning)
                    self.watcher.warn(warning)

    def _keep(self, kept: Sequence[tuple[Unit | Preparation, Outcome]]) -> None:
        """Write the outcomes of tasks: the records last, because they mark a unit as finished."""
        records: dict[Track, list[pa.Table]] = {}
        for work, outcome in kept:
            if isinstance(work, Preparation):
                assert outcome.artefact is not None
                artefacts.write(self.out, work, outcome.artefact)
                continue
            for seed, recording in outcome.recordings.items():
                keep_recording(recording_path(self.out, work, seed), recording)
            assert outcome.records is not None
            records.setdefault(work.track, []).append(outcome.records)
        for units in records.values():
            store.write_all(self.out, units)
            self.unpacked += len(units)
        if self.unpacked >= packing.UNITS:
            packing.pack(self.out)
            self.unpacked = 0


def keep_recording(path: Path, content: bytes) -> None:
    """Write a recording atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with files.whole(path) as file:
        file.write(content)


def recording_path(out: Path, unit: Unit, seed: int) -> Path:
    """The file of an episode's recording."""
    return out / "recordings" / unit.pair.id / f"{stem(unit.cell, seed)}.rrd"


def stem(cell: Cell, seed: int) -> str:
    """The name of an episode in the names of files: `lanes-3-density-1-weather-clear-1000000`."""
    return "-".join([*(f"{name}-{written(value)}" for name, value in cell.items()), str(seed)])


def _recorded(config: RunConfig, units: Iterable[Unit]) -> dict[str, Sequence[int]]:
    """The scenario seeds to record, by fingerprint of the unit: of the requested pairs, with their first training seed."""
    if config.record == 0:
        return {}
    requested = {pair.id for pair in config.pairs}
    first_units: dict[str, Unit] = {}
    for unit in units:
        first_units.setdefault(unit.pair.id, unit)
    recorded: dict[str, Sequence[int]] = {}
    for unit in units:
        first = first_units[unit.pair.id]
        first_round = unit.seeds.start == config.grid.first_seed
        wanted = first_round and unit.pair.id in requested and unit.training_seed == first.training_seed
        if wanted and (config.record is not None or unit is first):
            count = 1 if config.record is None else config.record
            recorded[unit.fingerprint] = unit.seeds[:count]
    return recorded


def _longest_first(unit: Unit) -> tuple[object, ...]:
    """Sort key: block after block; in each, attacked units first, then those with the highest values on their axes.

    So no long unit comes last, and a run that ends early has complete blocks.
    """
    numbers = [-value for value in unit.cell.values() if not isinstance(value, str)]
    return (unit.seeds.start, unit.pair.is_clean, *reversed(numbers))
