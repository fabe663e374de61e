"""Carries out a run: units of work in worker processes, a file of records for each that is finished.

A patch is crafted before the units that show it, and kept as a file for them.

A unit is a pure function of its configuration: results do not depend on the number of workers or the order of work.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Protocol

from bench.detection import approach, patches
from bench.detection.crafting import craft
from bench.detection.threat import Patch
from bench.driving import rollout
from bench.driving.drive import drive
from bench.driving.rollout import Columns
from bench.errors import UserError, reason
from bench.records import store as results
from bench.run.config import RunConfig
from bench.run.plan import plan
from bench.run.process import settle
from bench.run.unit import Crafting, Unit

NEWS_S = 1.0
"""Seconds between two looks at how far the patches are."""

Work = Unit | Crafting
Trace = rollout.Trace | approach.Trace


class Watcher(Protocol):
    """Told how a run goes; the command line draws its progress bar from it."""

    def begin(self, *, episodes: int, finished: int) -> None:
        """The run has `episodes` in all, of which `finished` were there already."""

    def working(self, works: Sequence[Work]) -> None:
        """These are being worked on now."""

    def crafting(self, work: str, share: float, text: str) -> None:
        """How far a patch is, in [0, 1], in the attack's own words."""

    def finished(self, work: Work, wall_s: float) -> None:
        """One more unit, or patch, is written; it took `wall_s` seconds."""

    def warn(self, line: str) -> None:
        """Something went wrong that does not touch the records."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A piece of work.

    Args:
        work: what to do.
        record: how many of a unit's first episodes to record in the results folder.
        out: results folder.
        after: fingerprint of the patch that must be there first; empty if none.
    """

    work: Work
    record: int = 0
    out: Path = Path()
    after: str = ""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a worker hands back: measurements [B] each (of a unit), wall seconds, and why a recording failed, if it did."""

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
    tasks = list(_tasks(config, {key: unit for key, unit in units.items() if key not in done}, units.values()))
    episodes = len(config.grid.seeds())
    watcher.begin(episodes=episodes * len(units), finished=episodes * len(done))
    with closing(_spread(_longest_first(tasks), config.workers, watcher)) as finished:
        for task, outcome in finished:
            if isinstance(task.work, Unit):
                constants = task.work.constants(outcome.wall_s)
                results.write(config.out, results.table(constants, outcome.columns, track=task.work.pair.track))
            watcher.finished(task.work, outcome.wall_s)
            if outcome.warning:
                watcher.warn(outcome.warning)
    return list(units)


def recording_path(out: Path, unit: Unit, seed: int) -> Path:
    """Where the recording of an episode is."""
    cell = f"{unit.cell.lanes}-lanes-density-{unit.cell.density:g}-{unit.cell.weather}"
    return out / "recordings" / unit.pair.id / f"{cell}-{seed}.rrd"


def save_recordings(out: Path, unit: Unit, trace: Trace) -> None:
    """Save a recording of each episode of a trace of the unit."""
    from bench import recording

    *_, world = (part.component for part in unit.parts)
    for number, episode in enumerate(trace.episodes):
        seed = unit.seeds[episode]
        path = recording_path(out, unit, seed)
        path.parent.mkdir(parents=True, exist_ok=True)
        meta = unit.constants(0.0) | {"seed": seed}
        if isinstance(trace, approach.Trace):
            recording.save_approach(trace.sightings[number], meta=meta, path=path)
        else:
            one = {name: [step[number : number + 1] for step in steps] for name, steps in trace.steps.items()}
            recording.save(rollout.Trace(episodes=[episode], steps=one), features=world.features, meta=meta, path=path)


def measured(unit: Unit, patch: Patch | None, record: Sequence[int]) -> tuple[Columns, Trace | None]:
    """Do the work of a unit and return its measurements, [B] each, and what recordings need.

    Args:
        unit: what to measure.
        patch: what `unit.crafting` made, of the detection track.
        record: episodes to trace, by their place among the unit's.
    """
    if unit.pair.track == "driving":
        driven = rollout.Trace(episodes=record) if record else None
        return drive(unit, driven), driven
    seen = approach.Trace(episodes=record) if record else None
    return approach.score(unit, patch, seen), seen


def _tasks(config: RunConfig, missing: Mapping[str, Unit], units: Iterable[Unit]) -> Iterator[Task]:
    """What is left to do, patches first, and what to record: of the pairs asked for, with one training seed."""
    asked = {pair.id for pair in config.pairs}
    first: dict[str, Unit] = {}
    for unit in units:
        first.setdefault(unit.pair.id, unit)
    craftings = {crafting.fingerprint: crafting for unit in missing.values() if (crafting := unit.crafting)}
    absent = {key for key in craftings if not patches.path_of(config.out, key).exists()}
    yield from (Task(work=craftings[key], out=config.out) for key in craftings if key in absent)
    for unit in missing.values():
        shown = first[unit.pair.id]
        wanted = unit.pair.id in asked and unit.training_seed == shown.training_seed
        episodes = config.record if config.record is not None else int(unit is shown)
        after = unit.crafting.fingerprint if unit.crafting else ""
        yield Task(work=unit, record=episodes if wanted else 0, out=config.out, after=after if after in absent else "")


def _longest_first(tasks: Iterable[Task]) -> list[Task]:
    """Patches, then attacked units before clean ones and dense traffic before light: no long one is left for the end."""

    def rank(task: Task) -> tuple[float, ...]:
        work = task.work
        return (1, work.pair.is_clean, -work.cell.density, -work.cell.lanes) if isinstance(work, Unit) else (0,)

    return sorted(tasks, key=rank)


def _spread(tasks: Sequence[Task], workers: int, watcher: Watcher) -> Generator[tuple[Task, Outcome], None, None]:
    """Carry out the tasks in this process or in several, and yield each as it is finished."""
    if min(workers, len(tasks)) <= 1:
        settle()
        for task in tasks:
            watcher.working([task.work])
            yield task, _perform(task, watcher.crafting)
        return
    others = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    news: SimpleQueue[tuple[str, float, str]] = context.SimpleQueue()
    pool = ProcessPoolExecutor(min(workers, len(tasks)), context, initializer=_begin_work, initargs=(news,))
    try:
        yield from _pooled(pool, tasks, workers, watcher, news)
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
    pool: ProcessPoolExecutor,
    tasks: Sequence[Task],
    workers: int,
    watcher: Watcher,
    news: SimpleQueue[tuple[str, float, str]],
) -> Iterator[tuple[Task, Outcome]]:
    """Keep every worker busy and no task waiting in the pool, so that what is in flight is what is worked on."""
    waiting = list(tasks)
    uncrafted = {task.work.fingerprint for task in tasks if isinstance(task.work, Crafting)}
    running: dict[Future[Outcome], Task] = {}
    while waiting or running:
        ready = [task for task in waiting if task.after not in uncrafted]
        for task in ready[: workers - len(running)]:
            waiting.remove(task)
            running[pool.submit(_perform, task)] = task
        watcher.working([task.work for task in running.values()])
        finished = wait(running, NEWS_S, FIRST_COMPLETED).done
        while not news.empty():
            watcher.crafting(*news.get())
        for future in finished:
            task = running.pop(future)
            outcome = future.result()
            uncrafted.discard(task.work.fingerprint)
            yield task, outcome


_news: SimpleQueue[tuple[str, float, str]] | None = None
"""Of a worker process: where it tells how far a patch is."""


def _tell(work: str, share: float, text: str) -> None:
    if _news is not None:
        _news.put((work, share, text))


def _begin_work(news: SimpleQueue[tuple[str, float, str]]) -> None:
    """Set up a worker process: one thread, deaf to Ctrl-C (the parent ends it), and gone when the parent is gone."""
    global _news
    _news = news
    settle()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _perform(task: Task, tell: Callable[[str, float, str], None] = _tell) -> Outcome:
    start = time.perf_counter()
    columns: Columns = {}
    trace: Trace | None = None
    try:
        if isinstance(task.work, Crafting):
            patches.write(task.out, task.work, craft(task.work, partial(tell, str(task.work))))
        else:
            crafting = task.work.crafting
            patch = patches.read(task.out, crafting.fingerprint) if crafting else None
            columns, trace = measured(task.work, patch, range(task.record))
    except UserError as error:
        raise UserError(f"{task.work}: {error}") from error
    # Third-party code may fail in any way; the person at the terminal is told which component did.
    except Exception as error:
        raise UserError(f"{task.work} failed: {reason(error)} (--debug shows where)") from error
    wall_s = time.perf_counter() - start
    return Outcome(columns=columns, wall_s=wall_s, warning=_record(task, trace) if trace else "")


def _record(task: Task, trace: Trace) -> str:
    """Save the recordings of a task; why it failed, or nothing."""
    assert isinstance(task.work, Unit)
    try:
        save_recordings(task.out, task.work, trace)
    # The records are the result; a recording is a view of them, and its failure must not lose them.
    except Exception as error:
        return f"{task.work} was not recorded: {reason(error)}"
    return ""
