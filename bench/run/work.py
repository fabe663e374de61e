"""Carries out one task. The outcome contains all results, so that no shared disk is needed."""

from __future__ import annotations

import secrets
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol

import pyarrow as pa

from cavbench import files
from cavbench.core.progress import listening
from cavbench.errors import PluginError, RefusedNetworkError, UserError, message, reason
from cavbench.identity.fingerprint import canonical
from cavbench.isolation.custody import listed
from cavbench.isolation.foreign import contained
from cavbench.isolation.framework import Snapshot
from cavbench.isolation.watch import TamperError
from cavbench.records.store import table
from cavbench.run.blame import blamed, named
from cavbench.run.keeping import Keeping
from cavbench.run.reach import within_reach
from cavbench.run.unit import Loading, Preparation, Unit


class Tell(Protocol):
    """Is told how far a piece of work is.

    Args:
        work: its name.
        share: share done, in [0, 1].
        text: of an attack that is prepared.
        episodes: of the units of the work; 0 for a preparation.
    """

    def __call__(self, work: str, share: float, text: str, episodes: int = 0) -> None: ...


@dataclass(frozen=True, kw_only=True)
class Task:
    """A piece of work with everything that it needs.

    Args:
        work: the unit, preparation or loading.
        artefacts: contents of the files of the units' preparations, by `Work.artefact`.
        recorded: scenario seeds of the episodes to record.
        entropy: seed of the probes of a replay; None draws one, which nobody can foresee.
        others: units to drive in the same batch (`cavbench.run.batches`).
    """

    work: Unit | Preparation | Loading
    artefacts: Mapping[str, bytes] = field(default_factory=dict)
    recorded: Sequence[int] = ()
    entropy: int | None = None
    others: Sequence[Unit] = ()

    def parts(self) -> list[Task]:
        """A task for each unit of a batch; none if it is not a batch."""
        return [replace(self, work=unit, others=()) for unit in (self.work, *self.others)] if self.others else []


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The results of a task.

    Args:
        wall_s: wall time in seconds; of several units in one batch, each has its share.
        records: records of a unit, with their provenance; otherwise None.
        artefact: content of the file of a preparation; otherwise None.
        weights: of a loading, the hashes of the networks; otherwise None.
        recordings: contents of the `.rrd` files of a unit, by scenario seed.
        warnings: problems that do not affect the records.
        others: the results of the task's other units, in their order.
        last: whether the settings of its process were changed, which must do no other work.
    """

    wall_s: float
    records: pa.Table | None = None
    artefact: bytes | None = None
    weights: tuple[str, str] | None = None
    recordings: Mapping[int, bytes] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    others: Sequence[Outcome | Failure] = ()
    last: bool = False

    def __getstate__(self) -> dict[str, Any]:
        """Records travel in Arrow's own format: unpickling a table takes eight times as long, column by column."""
        if self.records is None:
            return vars(self)
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, self.records.schema) as stream:
            stream.write_table(self.records)
        return vars(self) | {"records": sink.getvalue().to_pybytes()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        if (sent := state["records"]) is not None:
            with pa.ipc.open_stream(sent) as stream:
                state = state | {"records": stream.read_all()}
        vars(self).update(state)


@dataclass(frozen=True, kw_only=True)
class Failure:
    """Why a task has no results.

    Args:
        why: one line, which continues the name of the work: "failed: …" or "is refused: …".
        lost: whether it hung, ended its process, or used up its memory: a few of these and its pair is given up.
        died: whether it ended its process.
        bad_input: whether the options or the files of the user are the reason.
        tampered: whether it changed its process, which must do no other work.
        trace: the traceback, for --debug.
        others: the results of the task's other units, in their order; empty if these have none either.
    """

    why: str
    lost: bool = False
    died: bool = False
    bad_input: bool = False
    tampered: bool = False
    trace: str = ""
    others: Sequence[Outcome | Failure] = ()


def attempt(task: Task, tell: Tell, framework: Snapshot) -> Outcome | Failure:
    """Carry out a task; whatever foreign code raises is a `Failure` that names the package.

    Args:
        task: the task.
        tell: called with the progress.
        framework: the functions of the framework as they should be.
    """
    framework.extend()
    outcome = _together(task, tell) if task.others else _kept(task, tell)
    if changed := framework.changed():
        framework.restore()
        return Failure(why=f"is refused: {changed} was replaced{blamed(task.work.pair)}", tampered=True)
    return outcome


def _together(task: Task, tell: Tell) -> Outcome | Failure:
    """The outcomes of a task with several units: one after the other, if one batch gives no results."""
    keeping = Keeping([task.work.pair, *(unit.pair for unit in task.others)])
    try:
        with contained(), within_reach([task.work.pair, *(unit.pair for unit in task.others)]):
            outcomes: Sequence[Outcome | Failure] = _in_one_batch(task, tell)
    # Each unit alone says what is wrong with it.
    except Exception:
        outcomes = []
    if keeping.end().refused:
        outcomes = []
    first, *others = outcomes or [_kept(part, tell) for part in task.parts()]
    return replace(_noted(first, keeping), others=others)


def _in_one_batch(task: Task, tell: Tell) -> list[Outcome]:
    """The outcomes of units that are driven together; none if they must be driven one by one."""
    assert isinstance(task.work, Unit)
    units = (task.work, *task.others)
    start, entropy = time.perf_counter(), secrets.randbits(62)
    with _heard(units, tell):
        driven = units[0].track.drive_jointly([replace(unit.job, entropy=entropy) for unit in units], task.artefacts)
    if driven is None:
        return []
    per_episode = (time.perf_counter() - start) / sum(len(unit.seeds) for unit in units)
    outcomes = []
    for unit, result in zip(units, driven, strict=True):
        wall_s = per_episode * len(unit.seeds)
        records = table(unit.constants(wall_s), result.columns, track=unit.track)
        outcomes.append(Outcome(wall_s=wall_s, records=records))
    return outcomes


def _heard(units: Sequence[Unit], tell: Tell) -> AbstractContextManager[None]:
    """Passes on how far units are that are driven together."""
    name, episodes = str(units[0]), sum(len(unit.seeds) for unit in units)
    return listening(lambda share: tell(name, share, "", episodes))


def _kept(task: Task, tell: Tell) -> Outcome | Failure:
    """The outcome of a task with a single work; a `Failure` if a component remembers something that is not its own."""
    keeping = Keeping([task.work.pair])
    outcome = _alone(task, tell)
    if (found := keeping.end().refused) and isinstance(outcome, Outcome):
        why, parts = found
        return Failure(why=f"is refused: {why}{named(parts) or blamed(task.work.pair)}")
    return _noted(outcome, keeping)


def _noted(outcome: Outcome | Failure, keeping: Keeping) -> Outcome | Failure:
    """The outcome, with a line about what plug-ins kept; their process does no other work."""
    if not keeping.forgotten or not isinstance(outcome, Outcome):
        return outcome
    line = f"{keeping.origin} kept {listed(keeping.forgotten)} after a unit: it was put back, so that no unit depends on another"
    return replace(outcome, last=True, warnings=(*outcome.warnings, line))


def _alone(task: Task, tell: Tell) -> Outcome | Failure:
    work = task.work
    try:
        with contained(), within_reach([work.pair]):
            return _performed(task, tell)
    except TamperError as error:
        return Failure(why=f"is refused: {message(error)}{blamed(work.pair, error)}", trace=traceback.format_exc())
    except RefusedNetworkError as error:
        shipped = blamed(work.pair, error)
        why, bad_input = f"is refused: {message(error)}{shipped}", not shipped
        return Failure(why=why, bad_input=bad_input, trace=traceback.format_exc())
    except UserError as error:
        why, bad_input = f"failed: {message(error)}{blamed(work.pair, error)}", not isinstance(error, PluginError)
        return Failure(why=why, bad_input=bad_input, trace=traceback.format_exc())
    # Third-party code may raise anything: name the component that failed.
    except Exception as error:
        why = f"failed: {reason(error)} (--debug shows the traceback){blamed(work.pair, error)}"
        return Failure(why=why, trace=traceback.format_exc())


def _performed(task: Task, tell: Tell) -> Outcome:
    start = time.perf_counter()
    match task.work:
        case Unit() as unit:
            with _heard([unit], tell):
                return _driven(unit, task)
        case Preparation() as work:
            artefact = work.track.prepare(work.job, canonical(work.origin), partial(tell, str(work)))
            return Outcome(wall_s=time.perf_counter() - start, artefact=artefact)
        case Loading() as loading:
            weights, warnings = loading.tried()
            return Outcome(wall_s=time.perf_counter() - start, weights=weights, warnings=warnings)


def _driven(unit: Unit, task: Task) -> Outcome:
    start = time.perf_counter()
    entropy = secrets.randbits(62) if task.entropy is None else task.entropy
    artefact = task.artefacts.get(unit.artefact)
    driven = unit.track.drive(replace(unit.job, entropy=entropy), artefact, task.recorded)
    wall_s = time.perf_counter() - start
    constants = unit.constants(wall_s)
    try:
        records = table(constants, driven.columns, track=unit.track)
    except ValueError as error:
        raise UserError(f"its measurements have impossible values: {error}") from error
    recordings, warnings = _recordings(unit, driven.traces, constants)
    return Outcome(wall_s=wall_s, records=records, recordings=recordings, warnings=warnings)


def _recordings(
    unit: Unit, traces: Mapping[int, object], constants: Mapping[str, object]
) -> tuple[dict[int, bytes], tuple[str, ...]]:
    """The recordings of a unit, and why one failed: a failed recording must not lose the records."""
    found: dict[int, bytes] = {}
    with files.scratch() as folder:
        for seed, trace in traces.items():
            path = folder / f"{seed}.rrd"
            try:
                unit.track.record(unit.job, trace, {**constants, "seed": seed}, path)
                found[seed] = path.read_bytes()
            except Exception as error:
                return found, (f"{unit} was not recorded: {reason(error)}",)
    return found, ()
