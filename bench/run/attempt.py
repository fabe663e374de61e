"""Carries out one task in this process. The outcome contains all results, so that no shared disk is needed."""

from __future__ import annotations

import secrets
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial

from cavbench import files
from cavbench.core.progress import listening
from cavbench.errors import PluginError, RefusedNetworkError, UserError, message, reason
from cavbench.identity.fingerprint import canonical
from cavbench.isolation.custody import listed
from cavbench.isolation.foreign import contained
from cavbench.isolation.framework import Snapshot
from cavbench.isolation.watch import TamperError
from cavbench.records.store import table
from cavbench.run import networks
from cavbench.run.blame import blamed, named
from cavbench.run.keeping import Keeping
from cavbench.run.reach import within_reach
from cavbench.run.task import Outcome, Task, Tell
from cavbench.run.unit import Unit


def attempt(task: Task, tell: Tell, framework: Snapshot) -> Outcome:
    """Carry out a task; what foreign code raises becomes an outcome that names the package.

    Args:
        task: the task.
        tell: called with the progress.
        framework: the functions of the framework as they should be.
    """
    framework.extend()
    outcome = _together(task, tell) if task.others else _kept(task, tell)
    if changed := framework.changed():
        framework.restore()
        were = "were" if ", " in changed else "was"
        return Outcome(why=f"is refused: {changed} {were} replaced{blamed(task.pair)}", tampered=True)
    return outcome


def _together(task: Task, tell: Tell) -> Outcome:
    """The outcomes of a task with several units: one after the other, if one batch gives no results."""
    keeping = Keeping([unit.pair for unit in task.units])
    try:
        with contained(), within_reach([unit.pair for unit in task.units]):
            outcomes: Sequence[Outcome] = _in_one_batch(task, tell)
    # Each unit alone says what is wrong with it.
    except Exception:
        outcomes = []
    if keeping.end().refused:
        outcomes = []
    first, *others = outcomes or [_kept(part, tell) for part in task.each]
    return replace(_noted(first, keeping), others=others)


def _in_one_batch(task: Task, tell: Tell) -> list[Outcome]:
    """The outcomes of units that are driven together; none if they must be driven one by one."""
    units = task.units
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


def _kept(task: Task, tell: Tell) -> Outcome:
    """The outcome of a task with a single unit; a failure if a component remembers something that is not its own."""
    keeping = Keeping([task.pair])
    outcome = _alone(task, tell)
    if (found := keeping.end().refused) and not outcome.failed:
        why, parts = found
        return Outcome(why=f"is refused: {why}{named(parts) or blamed(task.pair)}")
    return _noted(outcome, keeping)


def _noted(outcome: Outcome, keeping: Keeping) -> Outcome:
    """The outcome, with a line about what plug-ins kept; their process does no other task."""
    if not keeping.forgotten or outcome.failed:
        return outcome
    line = f"{keeping.origin} kept {listed(keeping.forgotten)} after a unit: it was put back, so that no unit depends on another"
    return replace(outcome, last=True, warnings=(*outcome.warnings, line))


def _alone(task: Task, tell: Tell) -> Outcome:
    pair = task.pair
    try:
        with contained(), within_reach([pair]):
            return _performed(task, tell)
    except TamperError as error:
        return Outcome(why=f"is refused: {message(error)}{blamed(pair, error)}", trace=traceback.format_exc())
    except RefusedNetworkError as error:
        shipped = blamed(pair, error)
        why, bad_input = f"is refused: {message(error)}{shipped}", not shipped
        return Outcome(why=why, bad_input=bad_input, trace=traceback.format_exc())
    except UserError as error:
        why, bad_input = f"failed: {message(error)}{blamed(pair, error)}", not isinstance(error, PluginError)
        return Outcome(why=why, bad_input=bad_input, trace=traceback.format_exc())
    # Third-party code may raise anything: name the component that failed.
    except Exception as error:
        why = f"failed: {reason(error)} (--debug shows the traceback){blamed(pair, error)}"
        return Outcome(why=why, trace=traceback.format_exc())


def _performed(task: Task, tell: Tell) -> Outcome:
    start = time.perf_counter()
    unit = task.unit
    match task.step:
        case "drive":
            with _heard([unit], tell):
                return _driven(unit, task)
        case "prepare":
            made_by = canonical(unit.artefact_origin)
            artefact = unit.track.prepare(unit.preparing_job, made_by, partial(tell, str(task)))
            return Outcome(wall_s=time.perf_counter() - start, artefact=artefact)
        case "load":
            weights, warnings = networks.tried(task)
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
