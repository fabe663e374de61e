"""Replays an episode from its record alone and records it: bit for bit the same on the same type of machine."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from bench.errors import UserError
from bench.plugins import registry
from bench.plugins.framework import Snapshot
from bench.plugins.pair import Chosen, Pair, choose
from bench.plugins.track import track
from bench.records import reading
from bench.records.schema import IDENTITY
from bench.run import artefacts
from bench.run.runner import keep_recording, recording_path
from bench.run.unit import Unit
from bench.run.work import Failure, Task, attempt
from bench.scenarios import Cell


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
    noun, folder = unit.track.artefact or ("", "")
    path = out / folder / f"{record[noun]}.safetensors" if record.get(noun) else None
    task = Task(
        work=unit,
        artefact=artefacts.read(path) if path else None,
        recorded=[record["seed"]],
        entropy=record.get("entropy"),
    )
    outcome = attempt(task, lambda *news: None, Snapshot())
    if isinstance(outcome, Failure):
        raise UserError(f"{unit} {outcome.why}")
    after = outcome.records
    assert after is not None
    if not outcome.recordings:
        raise UserError("; ".join(outcome.warnings) or "nothing was recorded")
    saved = recording_path(out, unit, record["seed"])
    keep_recording(saved, outcome.recordings[record["seed"]])
    columns = [column.name for column in unit.track.measurements if column.name not in unit.track.unrepeatable]
    differences = tuple(name for name in columns if not _equal(before[name], after[name]))
    now = after.slice(0, 1).to_pylist()[0]
    origin = ("weights_sha256", "code_digest", "libraries", "machine")
    changed = ", ".join(name for name in origin if now[name] != record[name])
    if not changed and unit.adversary_sha256 and now["unit"] != record["unit"]:
        changed = "adversary"
    return Replay(saved, changed, differences)


def _unit(out: Path, record: Mapping[str, Any]) -> tuple[Unit, pa.Table]:
    """The unit of a record, and all records of that unit."""
    victim = _chosen("victim", record)
    track_of_victim = track(victim.component.tracks()[0])
    before = reading.read(out, [record["unit"]], track=track_of_victim).sort_by("seed")
    seeds = before["seed"].to_pylist()
    pair = Pair(
        attack=_chosen("attack", record),
        defense=_chosen("defense", record),
        victim=victim,
        world=_chosen("world", record),
        threat=victim.component.threat.recorded(record),
    )
    unit = Unit(
        pair=pair,
        cell=Cell(**json.loads(record["cell"])),
        training_seed=record["training_seed"],
        seeds=range(min(seeds), max(seeds) + 1),
        weights_sha256=pair.weights_sha256(record["training_seed"]),
        adversary_sha256=pair.adversary_sha256(record["training_seed"]),
    )
    return unit, before


def _chosen(kind: registry.Kind, record: Mapping[str, Any]) -> Chosen[Any]:
    params = json.loads(record[f"{kind}_params"])
    return choose(kind, record[kind], **{k: tuple(v) if isinstance(v, list) else v for k, v in params.items()})


def _equal(before: pa.ChunkedArray, after: pa.ChunkedArray) -> bool:
    """Whether all values are equal to the last bit; NaN equals NaN."""
    left, right = before.to_pylist(), after.to_pylist()
    return all(
        a == b or (isinstance(a, float) and np.isnan(a) and np.isnan(b)) for a, b in zip(left, right, strict=True)
    )
