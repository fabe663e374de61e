"""Carries out a run: passes its units of work to an executor, and writes the outcomes to files.

Preparations (patches) are made first and kept as files for their units. A unit is a pure function of its configuration: results
do not depend on the executor, the number of workers or the order of work.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Protocol

from bench import files
from bench.records import store
from bench.run import artefacts
from bench.run.batches import batches
from bench.run.config import RunConfig
from bench.run.executors import Executor, Watcher, executor
from bench.run.plan import plan
from bench.run.unit import Preparation, Unit
from bench.run.work import Outcome, Task
from bench.scenarios import Cell
from bench.scenarios.axes import written


class RunWatcher(Watcher, Protocol):
    """Receives the progress of a run."""

    def begin(self, *, episodes: int, finished: int) -> None:
        """The run has `episodes` in total, of which `finished` already have records."""

    def finished(self, work: Unit | Preparation, wall_s: float) -> None:
        """A unit or preparation is finished and written; it took `wall_s` seconds."""

    def warn(self, line: str) -> None:
        """Something went wrong that does not affect the records."""


def run(config: RunConfig, watcher: RunWatcher) -> list[str]:
    """Carry out the unfinished units of a run, and return the fingerprints of all its units.

    Raises:
        UserError: if the results folder cannot be written, weights are missing, a component fails or a worker dies; finished
            units are kept.
    """
    units = {unit.fingerprint: unit for unit in plan(config)}
    store.prepare(config.out)
    done = store.finished(config.out, units)
    missing = [unit for key, unit in units.items() if key not in done]
    episodes = len(config.grid.seeds())
    watcher.begin(episodes=episodes * len(units), finished=episodes * len(done))
    recorded = _recorded(config, units.values())
    preparations = {p.fingerprint: p for unit in missing if (p := unit.preparation)}
    absent = {key: p for key, p in preparations.items() if not artefacts.path_of(config.out, p).exists()}
    ready: list[Unit] = []
    waits: list[Unit] = []
    for unit in missing:
        (waits if unit.preparation and unit.preparation.fingerprint in absent else ready).append(unit)
    back_end = executor(config.executor, config.workers, len(missing) + len(absent))
    first: list[Preparation | Unit] = [*absent.values(), *sorted(ready, key=_longest_first)]
    for works in (first, sorted(waits, key=_longest_first)):
        _carry_out(batches(works, recorded, config.workers), config.out, recorded, back_end, watcher)
    return list(units)


def _carry_out(
    batches: Sequence[Sequence[Preparation | Unit]],
    out: Path,
    recorded: Mapping[str, Sequence[int]],
    back_end: Executor,
    watcher: RunWatcher,
) -> None:
    """Pass work to the executor, and write each outcome as soon as it is finished."""
    read = cache(artefacts.read)
    tasks = [_task(batch, out, recorded, read) for batch in batches]
    with closing(back_end.map(tasks, watcher)) as finished:
        for task, outcome in finished:
            for work, one in zip((task.work, *task.others), (outcome, *outcome.others), strict=True):
                _keep(work, one, out)
                watcher.finished(work, one.wall_s)
                for warning in one.warnings:
                    watcher.warn(warning)


def _task(
    batch: Sequence[Preparation | Unit],
    out: Path,
    recorded: Mapping[str, Sequence[int]],
    read: Callable[[Path], bytes],
) -> Task:
    work, *others = batch
    if isinstance(work, Preparation):
        return Task(work=work)
    artefact = read(artefacts.path_of(out, work.preparation)) if work.preparation else None
    units = [other for other in others if isinstance(other, Unit)]
    return Task(work=work, artefact=artefact, recorded=recorded.get(work.fingerprint, ()), others=units)


def _keep(work: Preparation | Unit, outcome: Outcome, out: Path) -> None:
    """Write the outcome of a work: the records last, because they mark it as finished."""
    if isinstance(work, Preparation):
        assert outcome.artefact is not None
        artefacts.write(out, work, outcome.artefact)
        return
    for seed, recording in outcome.recordings.items():
        keep_recording(recording_path(out, work, seed), recording)
    assert outcome.records is not None
    store.write(out, outcome.records)


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
    requested = {pair.id for pair in config.pairs}
    first_units: dict[str, Unit] = {}
    for unit in units:
        first_units.setdefault(unit.pair.id, unit)
    recorded: dict[str, Sequence[int]] = {}
    for unit in units:
        first = first_units[unit.pair.id]
        wanted = unit.pair.id in requested and unit.training_seed == first.training_seed
        if wanted and (config.record is not None or unit is first):
            count = 1 if config.record is None else config.record
            recorded[unit.fingerprint] = unit.seeds[:count]
    return recorded


def _longest_first(unit: Unit) -> tuple[object, ...]:
    """Sort key: attacked units first, then those with the highest values on their axes, so that no long unit comes last."""
    numbers = [-value for value in unit.cell.values() if not isinstance(value, str)]
    return (unit.pair.is_clean, *reversed(numbers))
