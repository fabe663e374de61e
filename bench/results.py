"""Episode records: an append-only Parquet data set, one file a finished unit of work, one row an episode.

A file appears whole or not at all, so a killed run leaves only finished units behind.
"""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from bench import files
from bench.errors import UserError

FOLDER = "episodes"


def _field(name: str, kind: pa.DataType, meaning: str, unit: str = "") -> pa.Field:
    return pa.field(name, kind, nullable=False, metadata={"unit": unit, "meaning": meaning})


_text, _float, _int = pa.string(), pa.float64(), pa.int64()

MEASUREMENTS: tuple[pa.Field, ...] = (
    _field("steps", pa.int32(), "decisions driven until the episode ended", "steps"),
    _field("return", _float, "highway-env's normalised reward, summed over the episode", "reward, 0 to 450"),
    _field("safe_progress", _float, "0 if crashed or off the road, else mean progress over 450 steps", "share, 0 to 1"),
    _field("crashed", pa.bool_(), "the ego hit another vehicle"),
    _field("offroad", pa.bool_(), "the ego left the road"),
    _field("distance_m", _float, "driven along the road", "m"),
    _field("min_ttc_s", _float, "smallest time to collision with the car ahead; inf if there was none", "s"),
    _field("mean_speed", _float, "mean over the steps", "m/s"),
    _field("queries", _float, "victim evaluations a step, mean", "queries"),
    _field("queries_median", _float, "victim evaluations a step, median", "queries"),
    _field("queries_max", _float, "victim evaluations a step, largest", "queries"),
    _field("changed", _float, "steps on which the attack changed the decision", "share, 0 to 1"),
    _field("linf", _float, "largest deviation of a step, mean over the steps", "normalised, 2 is the full range"),
    _field("linf_max", _float, "largest deviation of the episode", "normalised, 2 is the full range"),
    _field("l2", _float, "L2 norm of a step's deviation, mean over the steps", "normalised"),
    _field("linf_m", _float, "largest deviation of a position in a step, mean over the steps", "m"),
    _field("linf_mps", _float, "largest deviation of a velocity in a step, mean over the steps", "m/s"),
    _field("excess_max", _float, "farthest the attack's answer was outside its set, before projection", "normalised"),
    _field("attack_ms", _float, "the attack's wall time a step and episode (its batch's time shared out)", "ms"),
    _field("action_counts", pa.list_(pa.int32()), "times each discrete action was taken; empty for continuous ones"),
)
"""What `bench.rollout.rollout` measures of an episode, with `seed`."""

IDENTITY: tuple[pa.Field, ...] = (
    _field("unit", _text, "fingerprint of the unit of work: sha256 of everything that decides the result"),
    _field("pair", _text, "the attack, defence, victim, world and threat model: names and a short hash"),
    _field("attack", _text, "name"),
    _field("attack_params", _text, "canonical JSON"),
    _field("defense", _text, "name"),
    _field("defense_params", _text, "canonical JSON"),
    _field("victim", _text, "name"),
    _field("victim_params", _text, "canonical JSON"),
    _field("world", _text, "name"),
    _field("world_params", _text, "canonical JSON"),
    _field("action_type", _text, "the victim's: discrete or continuous"),
    _field("sees", pa.bool_(), "false for drivers that ignore the observation; their weather is always clear"),
    _field("training_seed", _int, "of the policy; 0 for victims that do not learn"),
    _field("threat_norm", _text, "perturbation set; a clean run has budget 0"),
    _field("threat_budget", _float, "size of the perturbation set", "share or normalised, by the norm"),
    _field("threat_access", _text, "the most the attacker may ask"),
    _field("threat_queries", _int, "most queries a step", "queries"),
    _field("grid", _text, "name of the grid"),
    _field("lanes", pa.int32(), "of the cell", "lanes"),
    _field("density", _float, "of the cell: highway-env's vehicles_density", "factor"),
    _field("weather", _text, "of the cell"),
    _field("seed", _int, "scenario seed of the episode"),
)
"""What was driven."""

PROVENANCE: tuple[pa.Field, ...] = (
    _field("attack_shipped_by", _text, "distribution and version"),
    _field("defense_shipped_by", _text, "distribution and version"),
    _field("victim_shipped_by", _text, "distribution and version"),
    _field("world_shipped_by", _text, "distribution and version"),
    _field("weights_sha256", _text, "of the policy's weights; empty where it has none"),
    _field("code_digest", _text, "sha256 of the source of the packages that computed it"),
    _field("libraries", _text, "JSON: versions of python, torch, torchrl, tensordict, highway-env, numba, numpy"),
    _field("machine", _text, "system, processor and number of cores"),
    _field("created_at", pa.timestamp("us", tz="UTC"), "when the unit was finished"),
    _field("wall_s", _float, "wall time of the unit, all its episodes", "s"),
)
"""What produced it, where and when."""

SCHEMA = pa.schema((*IDENTITY, *MEASUREMENTS, *PROVENANCE), metadata={"cavbench": "1"})
"""The columns of a record; each field's metadata says its unit and its meaning."""


def prepare(out: Path) -> None:
    """Make the results folder, or refuse it before any work is done.

    Raises:
        UserError: if nothing can be written there.
    """
    try:
        (out / FOLDER).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out / FOLDER):
            pass
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(f"the results folder {out} cannot be written: {reason}; choose another with out=") from None


def path_of(out: Path, unit: str) -> Path:
    """Where the records of a unit are, by its fingerprint."""
    return out / FOLDER / f"{unit}.parquet"


def finished(out: Path, units: Iterable[str]) -> set[str]:
    """The fingerprints among `units` whose records are there.

    Raises:
        UserError: if one of the files is truncated or foreign.
    """
    there = {unit for unit in units if path_of(out, unit).exists()}
    for unit in sorted(there):
        _check(path_of(out, unit))
    return there


def write(out: Path, records: pa.Table) -> Path:
    """Write the records of one unit and return the file; it appears whole or not at all."""
    path = path_of(out, records["unit"][0].as_py())
    try:
        with files.whole(path) as file:
            pq.write_table(records, file, compression="zstd")
    except OSError as error:
        raise UserError(f"the record {path} cannot be written: {error.strerror}") from error
    return path


def read(out: Path, units: Collection[str] | None = None) -> pa.Table:
    """Records as a table of `SCHEMA`, ordered by pair, training seed, cell and scenario seed.

    Args:
        out: results folder.
        units: fingerprints of the units to read. None reads the newest result of everything that is there: of each pair
            and training seed only what the newest code and weights made, and of a scenario driven twice the last one.

    Raises:
        UserError: if there are no records, or if a file is truncated or foreign.
    """
    if units is None:
        paths = sorted((out / FOLDER).glob("[!.]*.parquet"))
    else:
        paths = [path_of(out, unit) for unit in sorted(set(units))]
    if not paths:
        raise UserError(f"there are no records in {out}; `bench run out={out}` makes some")
    for path in paths:
        _check(path)
    query = "from read_parquet(?)" + (_NEWEST if units is None else "") + _ORDER
    try:
        with duckdb.connect() as connection:
            return connection.sql(query, params=[[str(path) for path in paths]]).to_arrow_table().cast(SCHEMA)
    except duckdb.Error as error:
        for path in paths:
            _check(path, thoroughly=True)
        raise UserError(f"the records in {out} cannot be read: {str(error).splitlines()[0]}") from error


_NEWEST = """
    qualify (code_digest, weights_sha256) = first_value((code_digest, weights_sha256)) over (
        partition by pair, training_seed order by created_at desc, unit)
    and row_number() over (
        partition by pair, training_seed, lanes, density, weather, seed order by created_at desc, unit) = 1
"""
_ORDER = " order by pair, training_seed, weather, lanes, density, seed"


def _check(path: Path, *, thoroughly: bool = False) -> None:
    """Refuse a file that is not a record: by its footer and columns, or by reading it all."""
    try:
        schema = pq.read_table(path).schema if thoroughly else pq.read_schema(path)
    except (pa.ArrowException, OSError) as error:
        reason = "not there" if isinstance(error, FileNotFoundError) else "truncated or not Parquet"
        raise UserError(f"the record {path} is {reason}; delete it and run again to make it anew") from None
    if not schema.equals(SCHEMA):
        raise UserError(f"the record {path} has other columns than this version writes; use another folder with out=")


def table(constants: Mapping[str, object], measured: Mapping[str, NDArray[np.generic]]) -> pa.Table:
    """The records of a unit, one row an episode.

    Args:
        constants: what every row says (`bench.plan.Unit.constants`).
        measured: a column [B] a measurement (`bench.rollout.rollout`); `action_counts` is [B, A].
    """
    rows = len(measured["seed"])
    columns = []
    for column in SCHEMA:
        values = [constants[column.name]] * rows if column.name in constants else measured[column.name].tolist()
        columns.append(pa.array(values, column.type))
    return pa.Table.from_arrays(columns, schema=SCHEMA)
