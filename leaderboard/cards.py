"""The card of a row: what produced it, where and when, and what to type to have it again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from leaderboard.entries import Entry
from leaderboard.pairs import codes_of, parameters

KINDS = ("attack", "defense", "victim", "world")


def card(entry: Entry, folder: Path | None) -> dict[str, object]:
    """The provenance of an entry.

    Args:
        entry: of any track.
        folder: the results folder, where its recordings may be; None where its records are published.
    """
    records, identity = entry.own.table, entry.identity
    seeds = entry.own.seeds
    _, units = np.unique(codes_of(records, ["unit"]), return_index=True)
    pair = str(records["pair"][0].as_py())
    return {
        "pair": pair,
        "components": {
            kind: {"name": identity[kind], "params": parameters(identity[f"{kind}_params"])} for kind in KINDS
        },
        "shipped_by": {kind: _values(records, f"{kind}_shipped_by") for kind in KINDS},
        "grid": _values(records, "grid"),
        "training_seeds": list(entry.own.runs),
        "scenario_seeds": [seeds[0], seeds[-1]],
        "episodes": records.num_rows,
        "left_out": entry.own.left_out,
        "weights_sha256": [value for value in _values(records, "weights_sha256") if value],
        "patch_sha256": [value for value in _values(records, "patch_sha256") if value]
        if entry.track == "detection"
        else [],
        "code_digest": _values(records, "code_digest"),
        "libraries": [json.loads(text) for text in _values(records, "libraries") if text],
        "machine": _values(records, "machine"),
        "finished": pc.max(records["created_at"]).as_py().isoformat(timespec="seconds"),
        "wall_s": round(pc.sum(records["wall_s"].take(pa.array(units))).as_py(), 1),
        "run": run_command(entry),
        "replay": replay_command(entry, pair, folder),
        "recording": _recording(pair, folder),
    }


def run_command(entry: Entry) -> str:
    """What makes the records of an entry again."""
    identity = entry.identity
    words = []
    for kind in KINDS:
        words.append(f"{kind}={identity[kind]}")
        words += [f"{kind}.{name}={_word(value)}" for name, value in parameters(identity[f"{kind}_params"]).items()]
    if entry.attacked:
        words += [
            f"threat.{name}={_word(identity[f'threat_{name}'])}" for name in ("norm", "budget", "access", "queries")
        ]
    for axis in ("lanes", "density", "weather"):
        values = dict.fromkeys(getattr(cell, axis) for cell in entry.own.cells)
        words.append(f"{axis}={','.join(_word(value) for value in values)}")
    words += [f"episodes={len(entry.own.seeds)}", f"seeds={','.join(map(str, entry.own.runs))}"]
    return shlex.join(["bench", "run", *words])


def replay_command(entry: Entry, pair: str, folder: Path | None) -> str:
    """What drives its first episode again and opens the recording."""
    cell, seed = entry.own.cells[0], entry.own.seeds[0]
    where = f"lanes={cell.lanes} density={cell.density:g} weather={cell.weather} seed={seed}"
    return f"bench view {pair} {where} --out {shlex.quote(str(folder or 'results'))}"


def _word(value: object) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return "[" + ",".join(_word(each) for each in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _values(records: pa.Table, name: str) -> list[str]:
    found: Iterable[str] = pc.unique(records[name]).to_pylist()
    return sorted(found)


def _recording(pair: str, folder: Path | None) -> str | None:
    """The first recording of a pair, as a path in the results folder."""
    found = sorted((folder / "recordings" / pair).glob("*.rrd")) if folder else []
    return found[0].relative_to(folder).as_posix() if folder and found else None
