"""Replays an episode from its record alone and records it: bit for bit the same on the same type of machine."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cavbench.core import registry
from cavbench.core.device import recorded as recorded_device
from cavbench.core.pair import IN_PROCESS, Chosen, Pair, choose
from cavbench.core.track import track
from cavbench.errors import UserError
from cavbench.isolation.framework import Snapshot
from cavbench.records import reading, store
from cavbench.records.schema import IDENTITY, SEQUENTIAL
from cavbench.run import artefacts
from cavbench.run.attempt import attempt
from cavbench.run.process import settle
from cavbench.run.results import keep_recording, recording_path, stem
from cavbench.run.task import Outcome, Task
from cavbench.run.unit import Unit
from cavbench.scenarios import Cell


@dataclass(frozen=True)
class Replay:
    """The result of a replay.

    Args:
        path: path of the recording.
        changed: names of what has changed since the record (weights, code, libraries, machine, adversary); empty if nothing has.
        differences: the measurements that differ from the record.
    """

    path: Path
    changed: str
    differences: tuple[str, ...]


def find(records: pa.Table, where: Mapping[str, str]) -> dict[str, Any]:
    """The first record with these values in its columns or on the axes of its cell: {"lanes": "3", "seed": "1000017"}.

    Raises:
        UserError: if a column is unknown or no record matches.
    """
    for name, value in where.items():
        column = records[name] if name in records.column_names else _on_axis(records, name)
        if column is None:
            known = [*(column.name for column in IDENTITY), *_axes(records)]
            raise UserError(registry.unknown(f"column {name!r}", name, known))
        try:
            wanted = pa.scalar(value).cast(column.type)
        except (pa.ArrowException, ValueError):
            raise UserError(f"cannot read {name}={value}: the column holds {column.type}") from None
        left = records.filter(pc.equal(column, wanted))
        if not left.num_rows:
            values = sorted(set(column.drop_null().to_pylist()))
            shown = ", ".join(map(str, values[:12])) + (f", … {values[-1]}" if len(values) > 12 else "")
            raise UserError(f"no record has {name}={value}; known values: {shown}")
        records = left
    return records.slice(0, 1).to_pylist()[0]


def _axes(records: pa.Table) -> list[str]:
    return list(dict.fromkeys(name for cell in pc.unique(records["cell"]).to_pylist() for name in json.loads(cell)))


def _on_axis(records: pa.Table, name: str) -> pa.ChunkedArray | None:
    """The values on an axis; None if no cell has it."""
    if name not in _axes(records):
        return None
    encoded = records["cell"].combine_chunks().dictionary_encode()
    values = pa.array([json.loads(cell).get(name) for cell in encoded.dictionary.to_pylist()])
    return pa.chunked_array([values.take(encoded.indices)])


def replay(out: Path, record: Mapping[str, Any]) -> Replay:
    """Repeat the unit of a record and save the recording of its episode.

    Args:
        out: results folder.
        record: one of its records.

    Raises:
        UserError: if a component, the weights or the artefact is missing.
    """
    unit, before = _unit(out, record)
    task = Task(
        unit=unit,
        artefacts=_artefacts(out, unit, record),
        recorded=[record["seed"]],
        entropy=record.get("entropy"),
    )
    outcome = _carried_out(task)
    after = outcome.records
    assert after is not None
    if not outcome.recordings:
        raise UserError("; ".join(outcome.warnings) or "nothing was recorded")
    saved = recording_path(out, unit, record["seed"])
    keep_recording(saved, outcome.recordings[record["seed"]])
    differences = _differences(unit, before, after)
    return Replay(saved, _changed(unit, record, after), differences)


def _carried_out(task: Task) -> Outcome:
    """The outcome of a task in this process; UserError if it fails."""
    outcome = attempt(task, lambda *news: None, Snapshot())
    if outcome.failed:
        raise UserError(f"{task} {outcome.why}")
    return outcome


def _changed(unit: Unit, record: Mapping[str, Any], after: pa.Table) -> str:
    """Names of what has changed since the record: weights, code, libraries, machine, adversary."""
    now = after.slice(0, 1).to_pylist()[0]
    origin = ("weights_sha256", "code_digest", "libraries", "machine")
    changed = ", ".join(name for name in origin if now[name] != record[name])
    if not changed and unit.adversary_sha256 and now["unit"] != record["unit"]:
        return "adversary"
    return changed


@dataclass(frozen=True)
class Repeated:
    """A unit that was driven again.

    Args:
        unit: the unit.
        before: its records.
        after: the records of the repetition.
        changed: names of what has changed since the record; empty if nothing has.
        differences: the measurements that differ.
    """

    unit: Unit
    before: pa.Table
    after: pa.Table
    changed: str
    differences: tuple[str, ...]


def repeat(out: Path, record: Mapping[str, Any]) -> Repeated:
    """Drive the unit of a record again, without a recording.

    Raises:
        UserError: if a component, the weights or the artefact is missing.
    """
    unit, before = _unit(out, record)
    task = Task(unit=unit, artefacts=_artefacts(out, unit, record), entropy=record.get("entropy"))
    after = _carried_out(task).records
    assert after is not None
    return Repeated(unit, before, after, _changed(unit, record, after), _differences(unit, before, after))


def film(out: Path, record: Mapping[str, Any]) -> tuple[Any, tuple[str, ...]]:
    """Repeat the unit of a record, and return the film of its episode and the measurements that differ from the record.

    Args:
        out: results folder.
        record: one of its records.

    Returns:
        A `cavbench.recording.film.Film`, and names of measurements.

    Raises:
        UserError: if a component, the weights or the artefact is missing, or the track makes no films.
    """
    unit, before = _unit(out, record)
    settle()
    driven = unit.track.drive(
        dataclasses.replace(unit.job, entropy=record.get("entropy") or 0),
        _artefacts(out, unit, record).get(unit.artefact),
        [record["seed"]],
    )
    made = unit.track.film(unit.job, driven.traces[record["seed"]], {**unit.constants(0.0), "seed": record["seed"]})
    after = store.table(unit.constants(0.0), driven.columns, track=unit.track)
    return made, _differences(unit, before, after)


def _artefacts(out: Path, unit: Unit, record: Mapping[str, Any]) -> dict[str, bytes]:
    """What was prepared for a unit when the record was made, by the fingerprint that it has now."""
    noun, folder = unit.track.artefact or ("", "")
    return {unit.artefact: artefacts.read(out / folder / f"{record[noun]}.safetensors")} if record.get(noun) else {}


def _differences(unit: Unit, before: pa.Table, after: pa.Table) -> tuple[str, ...]:
    columns = [column.name for column in unit.track.measurements if column.name not in unit.track.unrepeatable]
    return differing(columns, before, after)


def differing(columns: Iterable[str], before: pa.Table, after: pa.Table) -> tuple[str, ...]:
    """The columns in which two tables of the same rows differ in any bit."""
    return tuple(name for name in columns if not _equal(before[name], after[name]))


def recorded(out: Path, path: Path, records: pa.Table) -> dict[str, Any]:
    """The record of a recording's episode, by the name of the file.

    Raises:
        UserError: if none of the records of its pair is of that episode.
    """
    own = records.filter(pc.equal(records["pair"], path.parent.name)).sort_by("training_seed")
    for row in own.select(["cell", "seed"]).to_pylist():
        if stem(Cell(**json.loads(row["cell"])), row["seed"]) == path.stem:
            same = pc.and_(pc.equal(own["cell"], row["cell"]), pc.equal(own["seed"], row["seed"]))
            return own.filter(same).slice(0, 1).to_pylist()[0]
    raise UserError(f"{out} has no record of the recording {path}")


def pair_of(record: Mapping[str, Any]) -> Pair:
    """The pair of a record.

    Raises:
        UserError: if a component is not installed, or a parameter is not allowed any more.
    """
    victim = _chosen("victim", record)
    return Pair(
        attack=_chosen("attack", record),
        defense=_chosen("defense", record),
        victim=victim,
        world=_chosen("world", record),
        threat=victim.component.threat.recorded(record),
    )


def _unit(out: Path, record: Mapping[str, Any]) -> tuple[Unit, pa.Table]:
    """The unit of a record, and all records of that unit."""
    pair = pair_of(record)
    before = reading.read(out, [record["unit"]], track=track(pair.track)).sort_by("seed")
    seeds = before["seed"].to_pylist()
    unit = Unit(
        pair=pair,
        cell=Cell(**json.loads(record["cell"])),
        training_seed=record["training_seed"],
        seeds=range(min(seeds), max(seeds) + 1),
        weights_sha256=pair.weights_sha256(record["training_seed"]),
        adversary_sha256=pair.adversary_sha256(record["training_seed"]),
        sequential=record["grid"] == SEQUENTIAL,
        device=recorded_device(record["machine"]),
    )
    return unit, before


def _chosen(kind: registry.Kind, record: Mapping[str, Any]) -> Chosen[Any]:
    if record[f"{kind}_shipped_by"] == IN_PROCESS:
        raise UserError(
            f"{kind} {record[kind]!r} was an object of a Python process and cannot be loaded again; record=N of "
            "cavbench.score records episodes while they are driven"
        )
    params = json.loads(record[f"{kind}_params"])
    # Of a chain, each parameter holds those of a link.
    links = {
        name: choose(kind, name, **_values(value)).component
        for name, value in params.items()
        if isinstance(value, dict) and kind == "defense"
    }
    return choose(kind, record[kind], **{**_values(params), **links})


def _values(params: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in params.items()}


def _equal(before: pa.ChunkedArray, after: pa.ChunkedArray) -> bool:
    """Whether all values are equal to the last bit; NaN equals NaN."""
    left, right = before.to_pylist(), after.to_pylist()
    return all(
        a == b or (isinstance(a, float) and np.isnan(a) and np.isnan(b)) for a, b in zip(left, right, strict=True)
    )
