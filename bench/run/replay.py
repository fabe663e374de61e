"""Drives a recorded episode again, from its record alone, to look at it: bit for bit the same on the same kind of machine."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from bench.detection import patches
from bench.errors import UserError
from bench.plugins import registry
from bench.plugins.pair import THREATS, Chosen, Pair, choose
from bench.records import store as results
from bench.run.runner import measured, recording_path, save_recordings
from bench.run.unit import Unit
from bench.scenarios.grid import Cell

BESIDE = ("attack_ms", "patch")
"""Measurements that no replay can repeat, and the name of the patch, which changes with the code that crafts it."""


@dataclass(frozen=True)
class Replay:
    """What a replay made.

    Args:
        path: of the recording.
        changed: what has changed since the record was made (code, libraries, weights), in words; empty if nothing.
        differences: the measurements that came out otherwise than in the record.
    """

    path: Path
    changed: str
    differences: tuple[str, ...]


def find(records: pa.Table, where: Mapping[str, str]) -> dict[str, Any]:
    """The first record whose columns have these values, for instance {"lanes": "3", "seed": "1000017"}.

    Raises:
        UserError: if a column is unknown or no record fits.
    """
    for name, value in where.items():
        if name not in records.column_names:
            known = [field.name for field in results.IDENTITY] + ["location"] * ("location" in records.column_names)
            raise UserError(registry.unknown(f"column {name!r}", name, known))
        kind = records.schema.field(name).type
        try:
            wanted = pa.scalar(value).cast(kind)
        except (pa.ArrowException, ValueError):
            raise UserError(f"cannot read {name}={value}: the column holds {kind}") from None
        left = records.filter(pc.field(name) == wanted)
        if not left.num_rows:
            known = sorted(set(records[name].to_pylist()))
            shown = ", ".join(map(str, known[:12])) + (f", … {known[-1]}" if len(known) > 12 else "")
            raise UserError(f"no record has {name}={value}; there are {shown}")
        records = left
    return records.slice(0, 1).to_pylist()[0]


def replay(out: Path, record: Mapping[str, Any]) -> Replay:
    """Drive the unit of a record again and save the recording of its episode.

    Args:
        out: results folder.
        record: one row of it.

    Raises:
        UserError: if a component or the policy is not there any more.
    """
    track = results.track_of(record)
    before = results.read(out, [record["unit"]], track=track).sort_by("seed")
    unit = _unit(record, before["seed"].to_pylist())
    patch = patches.read(out, record["patch"]) if record.get("patch") else None
    now = unit.constants(0.0)
    measurements, trace = measured(unit, patch, [unit.seeds.index(record["seed"])])
    after = results.table(now, measurements, track=track)
    columns = [field.name for field in results.MEASUREMENTS[track] if field.name not in BESIDE]
    differences = tuple(name for name in columns if not _equal(before[name], after[name]))
    assert trace is not None
    save_recordings(out, unit, trace)
    origin = ("weights_sha256", "code_digest", "libraries", "machine")
    changed = ", ".join(name for name in origin if now[name] != record[name])
    return Replay(recording_path(out, unit, record["seed"]), changed, differences)


def _unit(record: Mapping[str, Any], seeds: list[int]) -> Unit:
    threat = THREATS[results.track_of(record)]
    pair = Pair(
        attack=_chosen("attack", record),
        defense=_chosen("defense", record),
        victim=_chosen("victim", record),
        world=_chosen("world", record),
        threat=threat(
            norm=record["threat_norm"],
            budget=record["threat_budget"],
            access=record["threat_access"],
            queries=record["threat_queries"],
        ),
    )
    return Unit(
        pair=pair,
        cell=Cell(lanes=record["lanes"], density=record["density"], weather=record["weather"]),
        training_seed=record["training_seed"],
        seeds=range(min(seeds), max(seeds) + 1),
        weights_sha256=pair.weights_sha256(record["training_seed"]),
    )


def _chosen(kind: registry.Kind, record: Mapping[str, Any]) -> Chosen[Any]:
    params = json.loads(record[f"{kind}_params"])
    return choose(kind, record[kind], **{k: tuple(v) if isinstance(v, list) else v for k, v in params.items()})


def _equal(before: pa.ChunkedArray, after: pa.ChunkedArray) -> bool:
    """The same values to the last bit, NaN equal to NaN."""
    left, right = before.to_pylist(), after.to_pylist()
    return all(
        a == b or (isinstance(a, float) and np.isnan(a) and np.isnan(b)) for a, b in zip(left, right, strict=True)
    )
