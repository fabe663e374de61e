"""The card of a row: what produced it, where and when, and what to type to have it again."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cavbench.core import registry, sets
from cavbench.core.registry import KINDS, Kind
from cavbench.core.sources import summary
from cavbench.leaderboard.comparisons.comparison import THREAT, Comparison, parameters
from cavbench.leaderboard.comparisons.typed import typed
from cavbench.records.table import group_codes

DEFAULTS = {("attack", "none"), ("defense", "none"), ("victim", "dqn"), ("world", "highway")}
"""What a command line has where nothing is typed."""
PLAIN = re.compile(r"[\w./+-]+")


def card(one: Comparison, folder: Path | None) -> dict[str, object]:
    """The provenance of a comparison.

    Args:
        one: of any track.
        folder: the results folder, where its recordings may be; None where its records are published.
    """
    records, identity = one.own.table, one.identity
    seeds = one.own.seeds
    _, units = np.unique(group_codes(records, ["unit"]), return_index=True)
    pair = str(records["pair"][0].as_py())
    return {
        "pair": pair,
        "components": {
            kind: {"name": identity[kind], "params": parameters(identity[f"{kind}_params"])} for kind in KINDS
        },
        "about": {kind: about(kind, str(identity[kind])) for kind in KINDS},
        "shipped_by": {kind: _values(records, f"{kind}_shipped_by") for kind in KINDS},
        "grid": _values(records, "grid"),
        "training_seeds": list(one.own.runs),
        "scenario_seeds": [seeds[0], seeds[-1]],
        "episodes": records.num_rows,
        "left_out": one.own.left_out,
        "weights_sha256": _hashes(records, "weights_sha256"),
        "artefact_sha256": _hashes(records, f"{one.track.artefact[0]}_sha256") if one.track.artefact else [],
        "code_digest": _values(records, "code_digest"),
        "libraries": [json.loads(text) for text in _values(records, "libraries") if text],
        "machine": _values(records, "machine"),
        "finished": pc.max(records["created_at"]).as_py().isoformat(timespec="seconds"),
        "wall_s": round(pc.sum(records["wall_s"].take(pa.array(units))).as_py(), 1),
        "run": run_command(one),
        "replay": replay_command(one, pair, folder),
        "recording": _recording(pair, folder),
    }


@cache
def about(kind: Kind, name: str) -> str:
    """What a component is, with the paper that its author names, and where its code is; empty if it is not installed."""
    claims = registry.entries(registry.GROUPS[kind]).get(name.partition(":")[0], ())
    if len(claims) != 1:
        return ""
    said = summary(claims[0].target)
    return f"{said}. Code: {claims[0].target}" if said else f"Code: {claims[0].target}"


def run_command(one: Comparison) -> str:
    """What makes the records of a comparison again."""
    identity = one.identity
    words = []
    for kind in KINDS:
        words += [f"{kind}={identity[kind]}"] if (kind, identity[kind]) not in DEFAULTS else []
        given = typed(kind, str(identity[kind]), parameters(identity[f"{kind}_params"]))
        words += [f"{kind}.{name}={_word(value)}" for name, value in given.items()]
    if one.is_attacked:
        # Every frame is the default, and tracks without frames do not know the option.
        limits = [name for name in THREAT if (name, identity[name]) != ("threat_share", 1)]
        norm, others = sets.split(str(identity["threat_norm"]))
        shown = {**identity, "threat_norm": norm}
        words += [f"threat.{name.removeprefix('threat_')}={_word(shown[name])}" for name in limits]
        words += [f"threat.{word}" for word in others]
    named = {grid.name for grid in registry.grids(str(identity["world"]))}
    words += [f"grid={name}" for name in _values(one.own.table, "grid") if name in named]
    return shlex.join(["bench", "run", *words, *_part(one)])


def _part(one: Comparison) -> list[str]:
    """The part of the grid, as far as it is not the whole of it."""
    grids = {grid.name: grid for grid in registry.grids(str(one.identity["world"]))}
    whole = grids.get(str(one.identity["grid"]))
    words = []
    for axis in one.axes:
        values = list(dict.fromkeys(cell[axis] for cell in one.cells))
        if whole is None or values != list(dict.fromkeys(cell[axis] for cell in whole.cells())):
            words.append(f"{axis}={','.join(_word(value) for value in values)}")
    if whole is None or len(one.own.seeds) != whole.episodes:
        words.append(f"episodes={len(one.own.seeds)}")
    if whole is None or list(one.own.runs) != list(range(whole.training_seeds)):
        words.append(f"seeds={','.join(map(str, one.own.runs))}")
    return words


def replay_command(one: Comparison, pair: str, folder: Path | None) -> str:
    """What drives its first episode again and opens the recording."""
    where = [f"{name}={_word(value)}" for name, value in one.cells[0].items()]
    words = ["bench", "view", pair, *where, f"seed={one.own.seeds[0]}", "--out", str(folder or "results")]
    return shlex.join(words)


def _word(value: object) -> str:
    """A value as the command line reads it back."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return "[" + ",".join(_word(each) for each in value) + "]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{name}:{_word(each)}" for name, each in value.items()) + "}"
    if isinstance(value, float):
        return f"{value:g}"
    text = str(value)
    # Other text means something in the grammar of the command line (commas sweep), or nothing at all.
    return text if PLAIN.fullmatch(text) else json.dumps(text, ensure_ascii=False)


def _hashes(records: pa.Table, name: str) -> list[str]:
    return [value for value in _values(records, name) if value] if name in records.column_names else []


def _values(records: pa.Table, name: str) -> list[str]:
    found: Iterable[str] = pc.unique(records[name]).to_pylist()
    return sorted(found)


def _recording(pair: str, folder: Path | None) -> str | None:
    """The first recording of a pair, as a path in the results folder."""
    found = sorted((folder / "recordings" / pair).glob("*.rrd")) if folder else []
    return found[0].relative_to(folder).as_posix() if folder and found else None
