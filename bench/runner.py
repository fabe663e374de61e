"""Carries out a run: units of work in worker processes, a file of records for each that is finished.

A unit is a pure function of its configuration: results do not depend on the number of workers or the order of work.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from bench import results
from bench.config import RunConfig
from bench.errors import UserError
from bench.plan import plan
from bench.process import settle
from bench.rollout import Columns, Trace
from bench.unit import Unit, drive


class Watcher(Protocol):
    """Told how a run goes; the command line draws its progress bar from it."""

    def begin(self, *, episodes: int, finished: int) -> None:
        """The run has `episodes` in all, of which `finished` were there already."""

    def working(self, units: Sequence[Unit]) -> None:
        """These are being worked on now."""

    def finished(self, unit: Unit, wall_s: float) -> None:
        """One more unit is written; it took `wall_s` seconds."""

    def warn(self, line: str) -> None:
        """Something went wrong that does not touch the records."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A unit and how many of its first episodes to record in the results folder."""

    unit: Unit
    record: int = 0
    out: Path = Path()


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a worker hands back: measurements [B] each, wall seconds, and why a recording failed, if it did."""

    columns: Columns
    wall_s: float
    warning: str


def run(config: RunConfig, watcher: Watcher) -> list[str]:
    """Do what is not done yet, and return the fingerprints of all units of the run.

    Raises:
        UserError: if the results folder cannot be written, a policy is missing, a component fails or a worker dies;
            what was finished until then is kept.
    """
    units = {unit.fingerprint: unit for unit in plan(config)}
    results.prepare(config.out)
    done = results.finished(config.out, units)
    tasks = [task for task in _tasks(config, units.values()) if task.unit.fingerprint not in done]
    episodes = len(config.grid.seeds())
    watcher.begin(episodes=episodes * len(units), finished=episodes * len(done))
    with closing(_spread(_longest_first(tasks), config.workers, watcher)) as finished:
        for task, outcome in finished:
            records = results.table(task.unit.constants(outcome.wall_s), outcome.columns)
            results.write(config.out, records)
            watcher.finished(task.unit, outcome.wall_s)
            if outcome.warning:
                watcher.warn(outcome.warning)
    return list(units)


def recording_path(out: Path, unit: Unit, seed: int) -> Path:
    """Where the recording of an episode is."""
    cell = f"{unit.cell.lanes}-lanes-density-{unit.cell.density:g}-{unit.cell.weather}"
    return out / "recordings" / unit.pair.id / f"{cell}-{seed}.rrd"


def save_recordings(out: Path, unit: Unit, trace: Trace) -> None:
    """Save a recording of each episode of a trace of the unit."""
    from bench.recording import save

    for number, episode in enumerate(trace.episodes):
        one = {name: [step[number : number + 1] for step in steps] for name, steps in trace.steps.items()}
        seed = unit.seeds[episode]
        path = recording_path(out, unit, seed)
        path.parent.mkdir(parents=True, exist_ok=True)
        save(
            Trace(episodes=[episode], steps=one),
            features=unit.pair.world.component.features,
            meta=unit.constants(0.0) | {"seed": seed},
            path=path,
        )


def _tasks(config: RunConfig, units: Iterable[Unit]) -> Iterator[Task]:
    """The units in the order of the plan, and what to record: of the pairs asked for, with one training seed."""
    asked = {pair.id: pair for pair in config.pairs}
    first: dict[str, Unit] = {}
    for unit in units:
        shown = first.setdefault(unit.pair.id, unit)
        wanted = unit.pair.id in asked and unit.training_seed == shown.training_seed
        episodes = config.record if config.record is not None else int(unit is shown)
        yield Task(unit=unit, record=episodes if wanted else 0, out=config.out)


def _longest_first(tasks: Iterable[Task]) -> list[Task]:
    """Attacked units before clean ones and dense traffic before light, so that no long one is left for the end."""
    return sorted(tasks, key=lambda t: (t.unit.pair.is_clean, -t.unit.cell.density, -t.unit.cell.lanes))


def _spread(tasks: Sequence[Task], workers: int, watcher: Watcher) -> Generator[tuple[Task, Outcome], None, None]:
    """Carry out the tasks in this process or in several, and yield each as it is finished."""
    if min(workers, len(tasks)) <= 1:
        settle()
        for task in tasks:
            watcher.working([task.unit])
            yield task, _perform(task)
        return
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(
        min(workers, len(tasks)), mp_context=multiprocessing.get_context("spawn"), initializer=_begin_work
    )
    try:
        yield from _pooled(pool, tasks, workers, watcher)
    except BrokenProcessPool:
        raise UserError(
            "a worker process died (killed, or out of memory); "
            "what was finished is kept, and the same command goes on from there"
        ) from None
    except BaseException:
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _pooled(
    pool: ProcessPoolExecutor, tasks: Sequence[Task], workers: int, watcher: Watcher
) -> Iterator[tuple[Task, Outcome]]:
    """Keep every worker busy and no task waiting in the pool, so that what is in flight is what is worked on."""
    waiting = list(reversed(tasks))
    running: dict[Future[Outcome], Task] = {}
    while waiting or running:
        while waiting and len(running) < workers:
            task = waiting.pop()
            running[pool.submit(_perform, task)] = task
        watcher.working([task.unit for task in running.values()])
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            task = running.pop(future)
            yield task, future.result()


def _begin_work() -> None:
    """Set up a worker process: one thread, deaf to Ctrl-C (the parent ends it), and gone when the parent is gone."""
    settle()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _perform(task: Task) -> Outcome:
    start = time.perf_counter()
    trace = Trace(episodes=range(task.record)) if task.record else None
    try:
        columns = drive(task.unit, trace)
    except UserError as error:
        raise UserError(f"{task.unit}: {error}") from error
    # Third-party code may fail in any way; the person at the terminal is told which component did.
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise UserError(f"{task.unit} failed: {reason} (--debug shows where)") from error
    wall_s = time.perf_counter() - start
    return Outcome(columns=columns, wall_s=wall_s, warning=_record(task, trace) if trace else "")


def _record(task: Task, trace: Trace) -> str:
    """Save the recordings of a task; why it failed, or nothing."""
    try:
        save_recordings(task.out, task.unit, trace)
    # The records are the result; a recording is a view of them, and its failure must not lose them.
    except Exception as error:
        return f"{task.unit} was not recorded: {type(error).__name__}: {error}".splitlines()[0]
    return ""
