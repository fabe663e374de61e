"""Carries out one task. The outcome contains all results, so that no shared disk is needed."""

from __future__ import annotations

import secrets
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import pyarrow as pa

from bench.errors import UserError, reason
from bench.plugins.fingerprint import canonical
from bench.records.store import table
from bench.run.unit import Preparation, Unit
from bench.trust.watch import TamperError

Tell = Callable[[str, float, str], None]
"""Called with the name of the work, the share done in [0, 1], and a short text."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A piece of work with everything that it needs.

    Args:
        work: the unit or preparation.
        artefact: content of the file of the unit's preparation; None if it has none.
        recorded: scenario seeds of the episodes to record.
        entropy: seed of the probes of a replay; None draws one, which nobody can foresee.
        others: units to drive in the same batch (`bench.run.batches`).
    """

    work: Unit | Preparation
    artefact: bytes | None = None
    recorded: Sequence[int] = ()
    entropy: int | None = None
    others: Sequence[Unit] = ()


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The results of a task.

    Args:
        wall_s: wall time in seconds; of several units in one batch, each has its share.
        records: records of a unit, with their provenance; None for a preparation.
        artefact: content of the file of a preparation; None for a unit.
        recordings: contents of the `.rrd` files of a unit, by scenario seed.
        warnings: problems that do not affect the records.
        others: the results of the task's other units, in their order.
    """

    wall_s: float
    records: pa.Table | None = None
    artefact: bytes | None = None
    recordings: Mapping[int, bytes] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    others: Sequence[Outcome] = ()


def perform(task: Task, tell: Tell) -> Outcome:
    """Carry out a task.

    Raises:
        UserError: if a component fails; the message names the work.
    """
    work = task.work
    if task.others and isinstance(work, Unit):
        return _together(work, task, tell)
    try:
        return _prepared(work, tell) if isinstance(work, Preparation) else _driven(work, task)
    except TamperError as error:
        kinds = {"attack": ("attack",), "defense": ("defense", "victim")}
        parts = [part for part in work.pair.parts if any(part.kind in kinds[side] for side in error.sides)]
        shipped = " and ".join(f"{part.kind} {part.name!r} of {part.shipped_by}" for part in parts)
        raise UserError(f"{work} is refused: {error} ({shipped})") from error
    except UserError as error:
        raise UserError(f"{work}: {error}") from error
    # Third-party code may raise anything: name the component that failed.
    except Exception as error:
        raise UserError(f"{work} failed: {reason(error)} (--debug shows the traceback)") from error


def _prepared(work: Preparation, tell: Tell) -> Outcome:
    start = time.perf_counter()
    artefact = work.track.prepare(work.job, canonical(work.origin), partial(tell, str(work)))
    return Outcome(wall_s=time.perf_counter() - start, artefact=artefact)


def _together(unit: Unit, task: Task, tell: Tell) -> Outcome:
    """The outcomes of a task with several units: one after the other, if one batch gives no results."""
    units = (unit, *task.others)
    outcomes = _in_one_batch(units) or [perform(Task(work=one), tell) for one in units]
    return replace(outcomes[0], others=outcomes[1:])


def _in_one_batch(units: Sequence[Unit]) -> list[Outcome]:
    """The outcomes of units that are driven together; none if they must be driven one by one."""
    start, entropy = time.perf_counter(), secrets.randbits(62)
    driven = units[0].track.drive_jointly([replace(unit.job, entropy=entropy) for unit in units])
    if driven is None:
        return []
    per_episode = (time.perf_counter() - start) / sum(len(unit.seeds) for unit in units)
    outcomes = []
    for unit, result in zip(units, driven, strict=True):
        wall_s = per_episode * len(unit.seeds)
        records = table(unit.constants(wall_s), result.columns, track=unit.track)
        outcomes.append(Outcome(wall_s=wall_s, records=records))
    return outcomes


def _driven(unit: Unit, task: Task) -> Outcome:
    start = time.perf_counter()
    entropy = secrets.randbits(62) if task.entropy is None else task.entropy
    driven = unit.track.drive(replace(unit.job, entropy=entropy), task.artefact, task.recorded)
    wall_s = time.perf_counter() - start
    constants = unit.constants(wall_s)
    try:
        records = table(constants, driven.columns, track=unit.track)
    except ValueError as error:
        raise UserError(f"its measurements cannot be: {error} ({_authors(unit)})") from error
    recordings, warnings = _recordings(unit, driven.traces, constants)
    return Outcome(wall_s=wall_s, records=records, recordings=recordings, warnings=warnings)


def _authors(unit: Unit) -> str:
    """The components of a unit that do not ship with cavbench, or all of them, with their packages."""
    shipped = {part: part.shipped_by for part in unit.pair.parts}
    foreign = {part: by for part, by in shipped.items() if by.partition(" ")[0] != "cavbench"}
    return ", ".join(f"{part.kind} {part.name!r} of {by}" for part, by in (foreign or shipped).items())


def _recordings(
    unit: Unit, traces: Mapping[int, object], constants: Mapping[str, object]
) -> tuple[dict[int, bytes], tuple[str, ...]]:
    """The recordings of a unit, and why one failed: a failed recording must not lose the records."""
    found: dict[int, bytes] = {}
    with tempfile.TemporaryDirectory(prefix="cavbench-") as folder:
        for seed, trace in traces.items():
            path = Path(folder) / f"{seed}.rrd"
            try:
                unit.track.record(unit.job, trace, {**constants, "seed": seed}, path)
                found[seed] = path.read_bytes()
            except Exception as error:
                return found, (f"{unit} was not recorded: {reason(error)}",)
    return found, ()
