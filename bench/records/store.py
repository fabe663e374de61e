"""Episode records: an append-only Parquet data set, one file a finished unit of work, one row an episode.

A file appears whole or not at all, so a killed run leaves only finished units behind.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from bench import files
from bench.errors import UserError
from bench.plugins.contracts import TRACKS, Track
from bench.records import validity
from bench.scenarios.grid import WEATHERS

FOLDER = "episodes"


def _field(name: str, kind: pa.DataType, meaning: str, unit: str = "") -> pa.Field:
    return pa.field(name, kind, nullable=False, metadata={"unit": unit, "meaning": meaning})


_text, _float, _int = pa.string(), pa.float64(), pa.int64()

_DRIVING: tuple[pa.Field, ...] = (
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
_DETECTION: tuple[pa.Field, ...] = (
    _field("location", _text, "of the approach"),
    _field(
        "confidence_mean",
        _float,
        "in the sign at its true place, mean over the frames; 0 in a frame that misses it",
        "0 to 1",
    ),
    _field("confidence_median", _float, "the same, median over the frames", "0 to 1"),
    _field("detection_rate", _float, "frames with a confidence above 0.25", "share, 0 to 1"),
    _field("first_seen_m", _float, "distance at which it is first detected; 0 if it never is", "m"),
    _field("confirmed_m", _float, "distance at which it is detected in 3 of the last 5 frames; 0 if it never is", "m"),
    _field("overrun_m", _float, "how far beyond the line the car stops; 0 if before it", "m"),
    _field("ran", pa.bool_(), "the car never braked for the sign, or stopped more than 1 m beyond the line"),
    _field(
        "visible_share", _float, "of the sign, mean over the frames: in the picture and not hidden", "share, 0 to 1"
    ),
    _field("false_alarms", _float, "stop signs detected where there is none, mean over the frames", "detections"),
    _field("queries", _float, "pictures the detector was asked about to craft the patch", "pictures"),
    _field("gradients", _float, "pictures whose gradient was taken to craft the patch", "pictures"),
    _field("crafting_s", _float, "wall time of crafting the patch", "s"),
    _field("excess", _float, "farthest the attack's own texels were outside [0, 1]", "texel value"),
    _field("patch", _text, "fingerprint of the patch, patches/<this>.safetensors; empty where there is none"),
    _field("patch_sha256", _text, "of its texels; empty where it leaves the sign alone"),
    _field("frame_distance_m", pa.list_(_float), "of each frame, from the camera to the sign", "m"),
    _field("frame_confidence", pa.list_(_float), "of each frame, in the sign at its true place", "0 to 1"),
    _field("frame_visible", pa.list_(_float), "of each frame, share of the sign to be seen", "share, 0 to 1"),
)
MEASUREMENTS: dict[Track, tuple[pa.Field, ...]] = {"driving": _DRIVING, "detection": _DETECTION}
"""What `bench.driving.rollout.rollout` measures of an episode, and `bench.detection.approach.score` of an approach; with `seed`."""

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
    _field("action_type", _text, "the victim's: discrete or continuous; empty for detectors"),
    _field("sees", pa.bool_(), "false for drivers that ignore the observation; their weather is always clear"),
    _field("training_seed", _int, "of the victim and of the patch; 0 where it changes nothing"),
    _field("threat_norm", _text, "perturbation set; a clean run has budget 0"),
    _field("threat_budget", _float, "size of the perturbation set", "share or normalised, by the norm"),
    _field("threat_access", _text, "the most the attacker may ask"),
    _field("threat_queries", _int, "most queries: a step of an episode, or a patch", "queries"),
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
    _field(
        "libraries",
        _text,
        "JSON: versions of python, torch and others that compute, and of a component's own libraries",
    ),
    _field("machine", _text, "system, processor and number of cores"),
    _field("created_at", pa.timestamp("us", tz="UTC"), "when the unit was finished"),
    _field("wall_s", _float, "wall time of the unit, all its episodes", "s"),
)
"""What produced it, where and when."""


def _probe(name: str, meaning: str, unit: str = "share, 0 to 1") -> pa.Field:
    return _field(name, _float, meaning, unit).with_nullable(True)


PROBES: tuple[pa.Field, ...] = (
    _probe("gradient_queries", "gradients the attack took: a step, mean; or of a patch", "gradients"),
    _probe("zero_gradients", "of the gradients the attack took, those that were 0 everywhere"),
    _probe("redrawn", "probes on which the victim, asked the same twice, scored it otherwise: it draws"),
    _probe("same_answer", "probes on which another episode's observation (a grey picture) got the same scores"),
    _probe("draws", "how often the attack asked about each observation, where the victim draws", "queries"),
)
"""What the flags of a leaderboard are measured by; null where nothing was measured, as in records older than these columns."""

SCHEMAS: dict[Track, pa.Schema] = {
    track: pa.schema((*IDENTITY, *measured, *PROVENANCE, *PROBES), metadata={"cavbench": "1"})
    for track, measured in MEASUREMENTS.items()
}
"""The columns of a record of each track; each field's metadata says its unit and its meaning. New ones come last."""
_OLDER: dict[Track, pa.Schema] = {
    track: pa.schema(list(schema)[: -len(PROBES)], metadata=schema.metadata) for track, schema in SCHEMAS.items()
}
"""Those of records that are older than `PROBES`; they are read with nulls."""
SCHEMA = SCHEMAS["driving"]


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


def upgraded(records: pa.Table, track: Track) -> pa.Table:
    """Records of any age with the columns of today, null where they were not measured."""
    for field in PROBES:
        if field.name not in records.column_names:
            records = records.append_column(field, pa.nulls(records.num_rows, field.type))
    return records.select(SCHEMAS[track].names).cast(SCHEMAS[track])


def track_of(columns: Collection[str]) -> Track:
    """The track whose records have these columns."""
    return next(track for track in TRACKS if set(_OLDER[track].names) <= set(columns))


def tracks(out: Path) -> list[Track]:
    """The tracks that a results folder has records of.

    Raises:
        UserError: if there are no records, or if a file is truncated or foreign.
    """
    found = {_check(path) for path in sorted((out / FOLDER).glob("[!.]*.parquet"))}
    if not found:
        raise UserError(_NOTHING.format(out=out))
    return [track for track in TRACKS if track in found]


def read_all(out: Path) -> dict[Track, pa.Table]:
    """The newest records of each track that a results folder has records of.

    Raises:
        UserError: if there are no records, or if a file is truncated or foreign.
    """
    return {track: read(out, track=track) for track in tracks(out)}


def read(out: Path, units: Collection[str] | None = None, *, track: Track = "driving") -> pa.Table:
    """Records of one track as a table of its schema, ordered by pair, training seed, cell and scenario seed.

    Args:
        out: results folder.
        track: whose records; those of the other are left alone.
        units: fingerprints of the units to read. None reads the newest result of everything that is there: of each pair
            and training seed only what the newest code and weights made, and of a scenario driven twice the last one.

    Raises:
        UserError: if there are no records, or if a file is truncated or foreign, or has values that cannot be.
    """
    if units is None:
        paths = sorted((out / FOLDER).glob("[!.]*.parquet"))
    else:
        paths = [path_of(out, unit) for unit in sorted(set(units))]
    paths = [path for path in paths if _check(path) == track]
    if not paths:
        raise UserError(_NOTHING.format(out=out))
    query = "from records" + (_NEWEST if units is None else "") + _ORDER
    with _records(out, paths, track) as connection:
        records = connection.sql(query).to_arrow_table().cast(SCHEMAS[track])
    return _valid(records, out, track)


def _valid(records: pa.Table, out: Path, track: Track) -> pa.Table:
    """Records as they are; refused, and their file named, if a value cannot be."""
    if found := validity.complaint(records, SCHEMAS[track]):
        row, why = found
        path = path_of(out, records["unit"][row].as_py())
        named = f"the record {path}" if path.exists() else f"a record in {out} (unit {path.stem})"
        raise UserError(f"{named} cannot be right: {why}; delete it and run again to make it anew")
    return records


def read_compact(out: Path, measurements: Collection[str]) -> dict[Track, pa.Table]:
    """The newest records of each track as `read` would choose them, small enough for a million: for leaderboards.

    Text columns are dictionaries. Of the measurements only those asked for are there, and `PROBES`.

    Args:
        out: results folder.
        measurements: names of columns in `MEASUREMENTS` that hold no lists.

    Raises:
        UserError: if there are no records, or if a file is truncated or foreign, or has values that cannot be.
    """
    paths: dict[Track, list[Path]] = {}
    for path in sorted((out / FOLDER).glob("[!.]*.parquet")):
        paths.setdefault(_glance(path), []).append(path)
    if not paths:
        raise UserError(_NOTHING.format(out=out))
    return {track: _read_compact(out, paths[track], track, measurements) for track in TRACKS if track in paths}


def _read_compact(out: Path, paths: list[Path], track: Track, measurements: Collection[str]) -> pa.Table:
    """A row a unit, as what its episodes share is most of a record, with its episodes as lists; these are laid out then."""
    shared = [field.name for field in (*IDENTITY, *PROVENANCE) if field.name not in ("unit", "seed")]
    wanted = [field.name for field in (*MEASUREMENTS[track], *PROBES) if field in PROBES or field.name in measurements]
    once = ", ".join(f'any_value("{name}") as "{name}"' for name in shared)
    lists = ", ".join(f'list("{name}") as "{name}"' for name in ("seed", *wanted))
    with _records(out, paths, track) as connection:
        connection.sql("set preserve_insertion_order = false")
        units = connection.sql(f"select unit, {once}, {lists} from records group by unit").to_arrow_table()
        alone = units.select(["unit", *shared]).append_column("row", pa.array(range(units.num_rows)))
        connection.register("alone", alone)
        newest = connection.sql(f"select row from alone {_NEWEST_UNITS} {_UNIT_ORDER}").to_arrow_table()
    units = units.take(newest["row"]).combine_chunks()
    rows = np.repeat(np.arange(units.num_rows), pc.list_value_length(units["seed"]).to_numpy())
    names = [name for name in SCHEMAS[track].names if name in units.column_names]
    return _valid(pa.table({name: _laid_out(units[name].chunk(0), rows) for name in names}), out, track)


def _laid_out(column: pa.Array, rows: NDArray[np.int64]) -> pa.Array:
    """A column of units as one of their episodes: lists are unpacked, text becomes a dictionary."""
    if pa.types.is_list(column.type):
        return column.flatten()
    if pa.types.is_string(column.type):
        encoded = column.dictionary_encode()
        return pa.DictionaryArray.from_arrays(encoded.indices.to_numpy()[rows], encoded.dictionary)
    return column.take(pa.array(rows))


@contextmanager
def _records(out: Path, paths: Sequence[Path], track: Track) -> Iterator[duckdb.DuckDBPyConnection]:
    """A connection whose view `records` is what is in files of one track; a file that cannot be read is named."""
    generations: dict[bool, list[str]] = {}
    for path in paths:
        generations.setdefault(b"same_answer" in _footer(path), []).append(str(path))
    nulls = ", ".join(f'null::double as "{field.name}"' for field in PROBES)
    parts = []
    for newer, files_of in generations.items():
        named = ", ".join("'" + path.replace("'", "''") + "'" for path in files_of)
        columns = _quoted(SCHEMAS[track].names if newer else _OLDER[track].names)
        parts.append(f"select {columns}{'' if newer else ', ' + nulls} from read_parquet([{named}])")
    try:
        with duckdb.connect() as connection:
            connection.sql("create view records as " + " union all by name ".join(parts))
            yield connection
    except duckdb.Error as error:
        for path in paths:
            _check(path, thoroughly=True)
        raise UserError(f"the records in {out} cannot be read: {str(error).splitlines()[0]}") from error


def _quoted(names: Iterable[str]) -> str:
    return ", ".join(f'"{name}"' for name in names)


def _footer(path: Path) -> bytes:
    """The end of a Parquet file, where its columns are named; reading it in full takes ten times as long."""
    try:
        with path.open("rb") as file:
            file.seek(-8, os.SEEK_END)
            size = int.from_bytes(file.read(4), "little")
            file.seek(-8 - size, os.SEEK_END)
            return file.read(size)
    except OSError:
        return b""


def _glance(path: Path) -> Track:
    """The track of a record by its footer; one that seems foreign is looked at in full, and refused."""
    footer = _footer(path)
    for track in TRACKS:
        if all(field.name.encode() in footer for field in MEASUREMENTS[track]):
            return track
    return _check(path)


_NOTHING = "there are no records in {out}; `bench run out={out}` makes some"
_NEWEST = """
    qualify (code_digest, weights_sha256) = first_value((code_digest, weights_sha256)) over (
        partition by pair, training_seed order by created_at desc, unit)
    and row_number() over (
        partition by pair, training_seed, lanes, density, weather, seed order by created_at desc, unit) = 1
"""
_NEWEST_UNITS = """
    qualify (code_digest, weights_sha256) = first_value((code_digest, weights_sha256)) over (
        partition by pair, training_seed order by created_at desc, unit)
"""
"""The same of units; of a scenario that two of them drove, `leaderboard.pairs.newest` keeps the last."""
_UNIT_ORDER = f" order by pair, training_seed, list_position({list(WEATHERS)}, weather), lanes, density, created_at"
_ORDER = " order by pair, training_seed, weather, lanes, density, seed"


def _check(path: Path, *, thoroughly: bool = False) -> Track:
    """The track of a record; refuse a file that is none: by its footer and columns, or by reading it all."""
    try:
        schema = pq.read_table(path).schema if thoroughly else pq.read_schema(path)
    except (pa.ArrowException, OSError) as error:
        reason = "not there" if isinstance(error, FileNotFoundError) else "truncated or not Parquet"
        raise UserError(f"the record {path} is {reason}; delete it and run again to make it anew") from None
    for track in TRACKS:
        if schema.equals(SCHEMAS[track]) or schema.equals(_OLDER[track]):
            return track
    raise UserError(f"the record {path} has other columns than this version writes; use another folder with out=")


def table(
    constants: Mapping[str, object], measured: Mapping[str, NDArray[np.generic]], *, track: Track = "driving"
) -> pa.Table:
    """The records of a unit, one row an episode.

    Args:
        constants: what every row says (`bench.run.plan.Unit.constants`).
        measured: a column [B] a measurement (`MEASUREMENTS`), [B, n] where it is a list.
        track: whose records they are.
    """
    rows = len(measured["seed"])
    columns = []
    for column in SCHEMAS[track]:
        values = [constants[column.name]] * rows if column.name in constants else measured[column.name].tolist()
        columns.append(pa.array(values, column.type, from_pandas=column.nullable))
    return pa.Table.from_arrays(columns, schema=SCHEMAS[track])
