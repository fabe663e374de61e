"""Records are written atomically; unreadable ones are reported in one line."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from datetime import timedelta
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cavbench.core.track import Columns, track
from cavbench.errors import Notice, UserError
from cavbench.records import reading, table
from cavbench.records import store as results
from cavbench.records.finished import finished
from cavbench.records.schema import schema
from cavbench.records.table import together
from cavbench.run.config import plan_of
from cavbench.run.unit import Unit

pytestmark = pytest.mark.usefixtures("toy_folder")

TRACK = track("driving")
SCHEMA = schema(TRACK)
WORDS = ("attack=nudge", "victim=toy", "world=toy", "lanes=3,4", "density=1", "weather=clear", "episodes=3", "seeds=0")


def drive(unit: Unit) -> Columns:
    return TRACK.drive(unit.job, None, []).columns


def read(out: Path, units: Sequence[str] | None = None) -> pa.Table:
    return reading.read(out, units, track=TRACK)


@pytest.fixture(scope="module")
def units(toy_folder: Path) -> list[Unit]:
    return plan_of([*WORDS, "reference=false"]).units()


@pytest.fixture
def written(units: list[Unit], tmp_path: Path) -> Path:
    """A results folder with the records of all units."""
    results.prepare(tmp_path)
    for unit in units:
        results.write(tmp_path, results.table(unit.constants(1.5), drive(unit), track=TRACK))
    return tmp_path


def test_a_rollout_returns_exactly_the_columns_of_the_schema(units: list[Unit]) -> None:
    measured = {field.name for field in (*TRACK.measurements, *TRACK.probes)} | {"seed"}
    assert set(drive(units[0])) == measured
    assert all(field.metadata[b"meaning"] for field in SCHEMA)


def test_records_are_read_as_written(written: Path, units: list[Unit]) -> None:
    records = read(written, [unit.fingerprint for unit in units])
    assert records.schema.equals(SCHEMA)
    assert records.num_rows == 3 * len(units)
    measured = drive(units[0])
    own = records.filter(pa.compute.equal(records["unit"], units[0].fingerprint))
    for name in ("safe_progress", "return", "linf", "seed"):
        np.testing.assert_array_equal(own[name].to_numpy(), measured[name])
    assert own["action_counts"].to_pylist() == measured["action_counts"].tolist()
    assert json.loads(own["attack_params"][0].as_py()) == {"mood": "calm", "pause": 0.0, "scale": 1.0}
    assert own["attack_shipped_by"][0].as_py() == "cavbench-toy 1.0"


def test_a_write_that_fails_leaves_nothing_behind(
    units: list[Unit], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results.prepare(tmp_path)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError, match="cannot be written: No space left on device"):
        results.write(tmp_path, results.table(units[0].constants(1.0), drive(units[0]), track=TRACK))
    assert list((tmp_path / "episodes").iterdir()) == []


def test_a_killed_writer_leaves_no_record(written: Path, units: list[Unit]) -> None:
    (written / "episodes" / f".{units[0].fingerprint}-x.tmp").write_bytes(b"PAR1 half")
    assert read(written).num_rows == 3 * len(units)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_truncated_record_is_named(written: Path, units: list[Unit], share: float) -> None:
    path = results.path_of(written, units[1].fingerprint)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(UserError, match=f"the record {path} is truncated or not Parquet; delete it"):
        read(written)


def test_a_record_with_a_column_whose_name_is_no_text_is_named(written: Path, units: list[Unit]) -> None:
    path = results.path_of(written, units[1].fingerprint)
    path.write_bytes(path.read_bytes().replace(b"machine", b"machin\xd8"))
    with pytest.raises(UserError, match=f"the record {path} is truncated or not Parquet"):
        read(written)


def test_a_record_whose_data_is_damaged_is_named(written: Path, units: list[Unit]) -> None:
    path = results.path_of(written, units[1].fingerprint)
    blob = bytearray(path.read_bytes())
    blob[4 : len(blob) // 3] = b"\xff" * (len(blob) // 3 - 4)
    path.write_bytes(bytes(blob))
    with pytest.raises(UserError, match=f"the record {path} is truncated or not Parquet"):
        read(written)


def test_a_foreign_table_is_reported_by_its_path(written: Path) -> None:
    path = written / "episodes" / "other.parquet"
    pq.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(UserError, match=f"the record {path} has columns that this version does not write"):
        read(written)


CANNOT_BE = {
    "safe_progress": (5.0, "safe_progress must be between 0 and 1, got 5"),
    "return": (float("nan"), "return must be between -1e+15 and 1e+15, got nan"),
    "distance_m": (1e300, "distance_m must be between -1e+15 and 1e+15, got 1e+300"),
    "mean_speed": (float("inf"), "mean_speed must be between -1e+15 and 1e+15, got inf"),
    "queries": (-1.0, "queries must be between 0 and 1e+15, got -1"),
    "min_ttc_s": (-0.5, "min_ttc_s must be at least 0, got -0.5"),
    "steps": (10**6, "steps must be between 0 and"),
    "action_counts": ([0, 0, -1, 0, 0], "action_counts must be between 0 and"),
    "threat_norm": ("l7", "threat_norm l7: known: relative, linf"),
    "threat_budget": (-0.1, "threat_budget must be between 0 and 1e+15, got -0.1"),
    "changed": (float("nan"), "changed must be between 0 and 1, got nan"),
    "cell": ('{"lanes":-1,"density":1.0,"weather":"clear"}', "lanes must be "),
    "world_facts": ("{}", "not a cell, or world_facts has no axes"),
    "attack": ("x" * 100_001, "attack has more than 100000 bytes"),
    "created_at": (2**63 - 1, "created_at must be in the years 1 to 9999"),
    "defense_params": ("[" * 20_000 + "]" * 20_000, "(40000 characters): nested too deeply"),
    "attack_params": ("{scale: 1}", "attack_params {scale: 1}: Expecting property name"),
    "world_params": ("[1]", "world_params [1]: not a JSON object"),
    "threat_access": ("all", "threat_access all: known: oblivious, decisions, scores, gradients, dynamics"),
}


MEASURED = {field.name for field in TRACK.measurements if not pa.types.is_list(field.type)}


@pytest.mark.parametrize("name", CANNOT_BE)
def test_an_invalid_value_is_reported_with_its_record(written: Path, units: list[Unit], name: str) -> None:
    value, why = CANNOT_BE[name]
    path = results.path_of(written, units[0].fingerprint)
    records = pq.read_table(path)
    place = records.schema.get_field_index(name)
    wrong = pa.array([value] * records.num_rows, records.schema.field(name).type)
    pq.write_table(records.set_column(place, records.schema.field(name), wrong), path)
    for reads in (read, lambda out: reading.read_all(out, MEASURED)):
        if reads is not read and name == "action_counts":  # compact records have no lists
            continue
        with pytest.raises(UserError) as raised:
            reads(written)
        assert str(raised.value).startswith(f"the record {path} is invalid: ")
        assert why in str(raised.value)


@pytest.mark.parametrize(
    ("fact", "value", "why"),
    [
        ("max_steps", None, "world_facts has no max_steps"),
        ("max_steps", "x", "world_facts has a wrong max_steps: x"),
        ("decision_hz", -1, "world_facts has a wrong decision_hz: -1"),
        ("decision_hz", 0, "world_facts has a wrong decision_hz: it must be above 0"),
        ("max_steps", 0, "world_facts has a wrong max_steps: it must be above 0"),
        ("features", 0, "world_facts has a wrong features: 0"),
        ("axes", [1], "not axes: each needs a name, a kind and a meaning"),
        ("axes", [{"name": "lanes"}], "not axes: each needs a name, a kind and a meaning"),
    ],
)
def test_wrong_facts_of_a_world_are_reported_with_their_record(
    written: Path, units: list[Unit], fact: str, value: object, why: str
) -> None:
    path = results.path_of(written, units[0].fingerprint)
    place = SCHEMA.get_field_index("world_facts")

    def change(own: pa.Table) -> pa.Table:
        facts = json.loads(own["world_facts"][0].as_py()) | {fact: value}
        text = json.dumps({name: found for name, found in facts.items() if found is not None})
        return own.set_column(place, SCHEMA.field(place), pa.array([text] * own.num_rows))

    rewritten(path, change)
    with pytest.raises(UserError, match=f"the record {path} is invalid: cell .*: {why}"):
        read(written)


def rewritten(path: Path, change: Callable[[pa.Table], pa.Table], to: Path | None = None) -> None:
    pq.write_table(change(pq.read_table(path)), to or path)


def replaced(own: pa.Table, name: str, value: object) -> pa.Table:
    field = own.schema.field(name)
    values = pa.array([value] * own.num_rows, field.type)
    return own.set_column(own.schema.get_field_index(name), field, values)


UNFINISHED: dict[str, tuple[Callable[[pa.Table, pa.Table], pa.Table], str]] = {
    "no rows": (lambda own, other: own.slice(0, 0), "it has 0 rows, the unit has 3 episodes"),
    "two rows": (lambda own, other: own.slice(0, 2), "it has 2 rows, the unit has 3 episodes"),
    "another unit": (lambda own, other: other, "it has the rows of another unit"),
    "an episode twice": (lambda own, other: own.take([0, 1, 1]), "it has other scenarios"),
    "impossible": (
        lambda own, other: replaced(own, "return", float("nan")),
        "return must be between -1e+15 and 1e+15, got nan",
    ),
    "without a column": (
        lambda own, other: own.drop_columns(["threat_share"]),
        "it has columns that this version does not write",
    ),
    "another pair": (lambda own, other: replaced(own, "pair", "other-none-toy"), "it has the rows of another pair"),
    "another cell": (
        lambda own, other: replaced(own, "cell", other["cell"][0].as_py()),
        "it has the rows of another cell",
    ),
    "another training seed": (
        lambda own, other: replaced(own, "training_seed", 7),
        "it has the rows of another training seed",
    ),
}


@pytest.mark.parametrize("what", UNFINISHED)
def test_a_unit_is_finished_if_its_own_rows_are_there(written: Path, units: list[Unit], what: str) -> None:
    change, why = UNFINISHED[what]
    wanted = {unit.fingerprint: unit for unit in units}
    assert finished(written, wanted) == set(wanted)
    first, second = (results.path_of(written, unit.fingerprint) for unit in units[:2])
    other = pq.read_table(second)
    rewritten(first, lambda own: change(own, other))
    content = first.read_bytes()
    with pytest.warns(Notice) as told:
        assert finished(written, wanted) == set(wanted) - {units[0].fingerprint}
    (line,) = (str(one.message) for one in told)
    assert line.startswith(f"the record {first} does not count as finished: {why}; its unit is driven again")
    assert not first.exists()
    assert (written / "set_aside" / first.name).read_bytes() == content


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_truncated_file_is_not_finished(written: Path, units: list[Unit], share: float) -> None:
    path = results.path_of(written, units[1].fingerprint)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    for number in range(2):
        with pytest.warns(Notice, match="does not count as finished: it is truncated or not Parquet"):
            assert finished(written, {units[1].fingerprint: units[1]}) == set()
        assert len(list((written / "set_aside").iterdir())) == number + 1
        path.write_bytes(b"PAR1")


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo], ids=["folder", "pipe"])
def test_what_is_no_file_is_not_read(written: Path, units: list[Unit], make: Callable[[Path], None]) -> None:
    path = results.path_of(written, units[0].fingerprint)
    path.unlink()
    make(path)
    for reads in (read, lambda out: reading.read_all(out, MEASURED)):
        with pytest.raises(UserError, match=f"the record {path} is not a file"):
            reads(written)
    with pytest.warns(Notice, match="does not count as finished: it is not a file"):
        assert finished(written, {units[0].fingerprint: units[0]}) == set()
    assert not path.exists()


def test_a_file_that_states_more_rows_than_the_unit_has_is_not_read(
    written: Path, units: list[Unit], monkeypatch: pytest.MonkeyPatch
) -> None:
    rewritten(results.path_of(written, units[0].fingerprint), lambda own: pa.concat_tables([own] * 1000))
    monkeypatch.setattr(pq, "read_table", None)
    with pytest.warns(Notice, match="it has 3000 rows, the unit has 3 episodes"):
        assert finished(written, {units[0].fingerprint: units[0]}) == set()


@pytest.mark.parametrize("compact", [False, True], ids=["show", "report"])
def test_a_row_or_a_column_twice_is_refused_by_every_reader(written: Path, units: list[Unit], compact: bool) -> None:
    def all_of_it() -> object:
        return reading.read_all(written, MEASURED) if compact else reading.read_all(written)

    path = results.path_of(written, units[0].fingerprint)
    own = pq.read_table(path)
    # Of files that begin alike only the first is checked: that must not hide a column.
    all_of_it()
    pq.write_table(own.append_column(own.schema.field("crashed"), own["crashed"]), path)
    with pytest.raises(UserError, match="has columns that this version does not write"):
        all_of_it()
    pq.write_table(own.take([0, 1, 1]), path)
    with pytest.raises(UserError, match="have an episode twice"):
        all_of_it()


def test_a_file_without_rows_is_read_the_same_by_every_reader(written: Path, units: list[Unit]) -> None:
    for path in written.glob("episodes/*.parquet"):
        pq.write_table(pq.read_table(path).slice(0, 0), path)
    assert len(reading.read_all(written)["driving"]) == len(reading.read_all(written, MEASURED)["driving"]) == 0


@pytest.mark.parametrize("compact", [False, True], ids=["show", "report"])
@pytest.mark.parametrize("name", ["crashed", "pair", "seed", "created_at", "steps"])
def test_a_column_of_another_type_is_refused_by_every_reader(
    name: str, compact: bool, written: Path, units: list[Unit]
) -> None:
    def all_of_it() -> object:
        return reading.read_all(written, MEASURED) if compact else reading.read_all(written)

    all_of_it()
    path = results.path_of(written, units[0].fingerprint)
    own = pq.read_table(path)
    place = own.column_names.index(name)
    pq.write_table(own.set_column(place, name, pa.nulls(len(own), pa.list_(pa.int64()))), path)
    with pytest.raises(UserError, match="has columns that this version does not write"):
        all_of_it()


@pytest.mark.parametrize("name", ["cell", "defense", "training_seed", "wall_s", "threat_budget"])
def test_rows_that_differ_from_their_unit_are_refused_by_every_reader(
    written: Path, units: list[Unit], name: str
) -> None:
    path = results.path_of(written, units[0].fingerprint)
    own, other = pq.read_table(path), pq.read_table(results.path_of(written, units[1].fingerprint))
    value = other[name][0].as_py() if name == "cell" else {"defense": "tracker"}.get(name, 7)
    field = own.schema.field(name)
    values = pa.array([*own[name].to_pylist()[:-1], value], field.type)
    pq.write_table(own.set_column(own.column_names.index(name), field, values), path)
    for reads in (reading.read_all, read, lambda out: reading.read_all(out, MEASURED)):
        with pytest.raises(UserError, match=f"the record {path} is invalid: its rows differ in {name}: "):
            reads(written)


def test_a_text_that_a_dictionary_lists_twice_is_one_text(written: Path) -> None:
    own = reading.read_all(written)["driving"]
    name = own["pair"][0].as_py()
    twice = pa.DictionaryArray.from_arrays(pa.array([0, 1] * 30, pa.int32()).slice(0, len(own)), pa.array([name] * 2))
    whole = together([own.set_column(own.column_names.index("pair"), "pair", twice)])
    assert whole["pair"].chunk(0).dictionary.to_pylist() == [name]


def test_a_file_that_states_too_many_rows_is_not_read(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "MOST_ROWS", 2)
    with pytest.raises(UserError, match="states more than 2 rows; delete it and run again to recreate it"):
        reading.read_all(written)


@pytest.mark.parametrize("name", ["recordings", "set_aside", "stops", "patches", "verifying", "episodes"])
def test_a_file_with_the_name_of_a_folder_is_found_before_any_work(name: str, tmp_path: Path) -> None:
    (tmp_path / name).touch()
    with pytest.raises(UserError, match=f"the results folder {tmp_path / name} cannot be written: it is a file"):
        results.prepare(tmp_path)


def test_a_copied_file_counts_once(written: Path, units: list[Unit]) -> None:
    before = read(written), reading.read_all(written, MEASURED)
    path = results.path_of(written, units[0].fingerprint)
    for name in ("0-copy.parquet", "z-copy.parquet"):
        shutil.copy(path, path.parent / name)
    assert read(written).equals(before[0])
    assert read(written, [units[0].fingerprint]).num_rows == 3
    for name, records in reading.read_all(written, MEASURED).items():
        assert records.num_rows == before[1][name].num_rows


@pytest.mark.parametrize("name", ["victim=other", "a*b", "[ab]", "it's"])
def test_the_name_of_a_results_folder_is_no_pattern_and_no_column(written: Path, units: list[Unit], name: str) -> None:
    before = read(written), reading.read_all(written, MEASURED)["driving"]
    for beside in ("aXb", "a"):
        results.prepare(written / beside)
        for unit in units:
            path = results.path_of(written, unit.fingerprint)
            rewritten(path, lambda own: own.slice(0, 1), results.path_of(written / beside, unit.fingerprint))
    shutil.copytree(written / "episodes", written / name / "episodes")
    assert read(written / name).equals(before[0])
    assert reading.read_all(written / name, MEASURED)["driving"].equals(before[1])
    assert len(finished(written / name, {unit.fingerprint: unit for unit in units})) == len(units)


def test_a_record_from_the_future_is_not_the_newest(written: Path, units: list[Unit]) -> None:
    today = read(written)
    rows = read(written, [units[0].fingerprint]).to_pylist()
    future = [
        row | {"unit": "future", "code_digest": "future", "created_at": row["created_at"].replace(year=2999)}
        for row in rows
    ]
    results.write(written, pa.Table.from_pylist(future, SCHEMA))
    with pytest.warns(
        Notice, match=r"the record .*future\.parquet is dated in the future: such records count as older"
    ):
        assert read(written).equals(today)
    with pytest.warns(Notice):
        assert "future" not in reading.read_all(written, MEASURED)["driving"]["code_digest"].to_pylist()
    for unit in units:
        results.path_of(written, unit.fingerprint).unlink()
    with pytest.warns(Notice):
        assert set(read(written)["code_digest"].to_pylist()) == {"future"}


def test_values_that_cannot_be_are_not_written(units: list[Unit]) -> None:
    measured = dict(drive(units[0]))
    measured["return"] = np.array([1.0, float("nan"), 2.0])
    seed = units[0].seeds[1]
    with pytest.raises(ValueError, match=rf"return must be .* got nan in scenario seed {seed}"):
        results.table(units[0].constants(1.0), measured, track=TRACK)


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"the results folder .*file/results cannot be written: Not a directory"):
        results.prepare(tmp_path / "file" / "results")


def test_an_empty_folder_says_how_to_fill_it(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"there are no records in .*; create some with `bench run out="):
        read(tmp_path)


def test_reading_a_folder_keeps_the_newest_code_and_each_scenario_once(written: Path, units: list[Unit]) -> None:
    old = read(written, [units[0].fingerprint]).to_pylist()
    newer = [
        row | {"unit": "newer", "code_digest": "newer", "created_at": row["created_at"] + timedelta(minutes=5)}
        for row in old
    ]
    longer = [row | {"unit": "longer", "seed": row["seed"] + 1} for row in newer]
    for rows in (newer, longer):
        results.write(written, pa.Table.from_pylist(rows, SCHEMA))
    records = read(written).to_pylist()
    same_pair = [row for row in records if (row["pair"], row["cell"]) == (old[0]["pair"], old[0]["cell"])]
    assert {row["code_digest"] for row in same_pair} == {"newer"}
    assert sorted(row["seed"] for row in same_pair) == sorted({row["seed"] for row in newer + longer})


def test_rows_are_not_hidden_by_what_a_file_says_of_its_values(written: Path, units: list[Unit]) -> None:
    """A file states the least and the greatest value of each column, and readers skip what cannot match."""
    key = units[0].fingerprint
    path = results.path_of(written, key)
    honest = read(written, [key])
    content = path.read_bytes()
    footer = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    other = bytes(reversed(key.encode()))
    assert key.encode() in content[footer:]
    path.write_bytes(content[:footer] + content[footer:].replace(key.encode(), other))
    assert read(written, [key]).equals(honest)
