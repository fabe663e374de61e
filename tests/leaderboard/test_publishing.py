"""Publishing: a file of records and a face for each row, and nothing of other rows."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from cavbench.core import suites
from cavbench.core.track import Track, tracks
from cavbench.errors import UserError
from cavbench.leaderboard.published import publish, publish_worlds, published, rounded, row_files
from cavbench.records import reading
from cavbench.records import store as results
from cavbench.records.schema import schema
from cavbench.records.table import plain
from tests.leaderboard.synthetic import CLEAR, GRID, approach, baseline_drivers, drive


def ran(folder: Path, *tables: pa.Table) -> Path:
    """A results folder with these records."""
    results.prepare(folder)
    for number, records in enumerate(tables):
        pq.write_table(records, folder / results.FOLDER / f"{number}.parquet")
    return folder


def row(attack_skill: float = 0.3, **more: object) -> pa.Table:
    """The records of a row: without an attack, and under one."""
    return pa.concat_tables(
        [drive(cells=CLEAR, **more), drive(cells=CLEAR, attack="zo", skill=attack_skill, queries=9.0, **more)]
    )


@pytest.mark.parametrize("own", [one for one in tracks() if one.name in ("driving", "detection")])
def test_published_records_have_the_schema_of_records(own: Track) -> None:
    assert published(own).num_rows
    assert plain(published(own)).schema.equals(schema(own))


@pytest.mark.parametrize(
    ("recorded", "name", "score"),
    [
        (row(), f"{GRID.name}/dqn", "safe_progress"),
        (pa.concat_tables([approach(0.9), approach(0.1, attack="eot")]), "approach-v1/yolov3_tiny", "confidence_mean"),
    ],
)
def test_what_is_published_is_what_was_recorded(tmp_path: Path, recorded: pa.Table, name: str, score: str) -> None:
    assert publish(ran(tmp_path / "out", recorded), tmp_path) == {name: recorded.num_rows}
    shipped = reading.read_file(tmp_path / "data" / f"{name}.parquet")
    assert sorted(shipped[score].to_pylist()) == sorted(recorded[score].to_pylist())


def test_a_row_is_two_files_and_a_second_row_changes_neither(tmp_path: Path) -> None:
    publish(ran(tmp_path / "one", row()), tmp_path)
    files = {path: path.read_bytes() for path in tmp_path.glob("*/*/dqn.*") if path.parts[-3] in ("data", "rows")}
    assert {path.suffix for path in files} == {".parquet", ".json"}
    publish(ran(tmp_path / "two", row(defense="shield")), tmp_path)
    assert {path: path.read_bytes() for path in files} == files
    assert (tmp_path / "rows" / GRID.name / "dqn+shield.json").exists()


def test_rows_of_one_name_have_a_file_each(tmp_path: Path) -> None:
    for number, behind in enumerate(("", "shield", "shield")):
        publish(ran(tmp_path / str(number), row(victim_params={"behind": behind})), tmp_path)
    assert len(list((tmp_path / "rows" / GRID.name).glob("dqn*.json"))) == 2


def test_a_parameter_that_came_later_makes_no_other_row(tmp_path: Path) -> None:
    """The old records go: their pairs have other names, so both together would be a row of two defences."""
    old, new = (
        {"defense": "shield", "defense_params": params} for params in ({"band": 0.0}, {"band": 0.0, "distance": 0.4})
    )
    publish(ran(tmp_path / "old", row(**old)), tmp_path)
    publish(ran(tmp_path / "new", row(**new)), tmp_path, add=True)
    (file,) = (tmp_path / "data" / GRID.name).glob("dqn+shield*.parquet")
    assert [json.loads(one) for one in set(reading.read_file(file)["defense_params"].to_pylist())] == [
        new["defense_params"]
    ]
    publish(ran(tmp_path / "other", row(**{**new, "defense_params": {"distance": 0.5}})), tmp_path, add=True)
    assert len(list((tmp_path / "data" / GRID.name).glob("dqn+shield*.parquet"))) == 2


def test_a_face_says_the_score_and_its_records(tmp_path: Path) -> None:
    publish(ran(tmp_path / "out", row(0.1)), tmp_path)
    face = json.loads((tmp_path / "rows" / GRID.name / "dqn.json").read_text())
    assert face["interval"][0] < face["score"] < face["interval"][1] < face["clean"]
    assert (face["strongest_attack"], face["attacks"], face["training_seeds"]) == ("zo", ["zo"], [0, 1, 2])


def test_baselines_are_one_file_and_are_only_added_to(tmp_path: Path) -> None:
    found = publish(ran(tmp_path / "all", row(), baseline_drivers(episodes=20)), tmp_path)
    assert list(found) == [f"{GRID.name}/dqn", f"{GRID.name}/baselines"]
    assert publish(ran(tmp_path / "few", row(), baseline_drivers(episodes=3)), tmp_path) == found
    assert not (tmp_path / "rows" / GRID.name / "baselines.json").exists()


def test_times_are_published_with_three_digits() -> None:
    times = {"wall_s": [1.23456, None], "attack_ms": [1234.5, 0.0], "safe_progress": [0.123456, 1.0]}
    assert rounded(pa.table(times)).to_pydict() == {
        "wall_s": [1.23, None],
        "attack_ms": [1230.0, 0.0],
        "safe_progress": [0.123456, 1.0],
    }


def test_perturbations_are_published_in_single_precision_and_scores_as_they_are() -> None:
    exact = {"l2": [1 / 3, None], "safe_progress": [1 / 3, 1.0]}
    assert rounded(pa.table(exact)).to_pydict() == {
        "l2": [float(np.float32(1 / 3)), None],
        "safe_progress": [1 / 3, 1.0],
    }


def scores_of(records: pa.Table, run: int) -> list[float]:
    """The scores of a training seed, sorted."""
    return sorted(records["safe_progress"].filter(pc.equal(records["training_seed"], run)).to_pylist())


def test_added_records_renew_a_training_seed_and_leave_the_others(tmp_path: Path) -> None:
    """A folder with fewer episodes of a pair and seed than the row renews nothing of it."""
    attack = {"attack": "zo", "queries": 9.0}
    first = drive(cells=CLEAR, skill=0.3, **attack)
    again, few = (
        drive(cells=CLEAR, runs=(1,), skill=0.9, **attack),
        drive(cells=CLEAR[:1], runs=(2,), skill=0.8, **attack),
    )
    for number, records in enumerate((first, again, few)):
        publish(ran(tmp_path / str(number), records), tmp_path, add=number > 0)
    shipped = reading.read_file(tmp_path / "data" / GRID.name / "dqn.parquet")
    assert [scores_of(shipped, run) for run in (0, 1, 2)] == [
        scores_of(first, 0),
        scores_of(again, 1),
        scores_of(first, 2),
    ]
    assert scores_of(again, 1) != scores_of(first, 1)


def test_records_of_worlds_are_a_file_a_defended_victim_and_rank_nothing_within_a_world(tmp_path: Path) -> None:
    def world(name: str) -> pa.Table:
        records = pa.concat_tables([row(), baseline_drivers(episodes=20)])
        # Units and pairs are hashes of all that they are of, the world too.
        renamed = {key: [f"{one}{name}" for one in records[key].to_pylist()] for key in ("unit", "pair")}
        for column, values in {**renamed, "world": [name] * records.num_rows}.items():
            place = records.schema.get_field_index(column)
            records = records.set_column(place, records.schema.field(place), pa.array(values))
        return records

    suite = suites.suite("worlds").name
    found = publish_worlds(ran(tmp_path / "one", world("highway"), world("merge")), tmp_path)
    assert list(found) == [f"{suite}/dqn", f"{suite}/baselines"]
    again = publish_worlds(ran(tmp_path / "two", world("exit")), tmp_path)
    assert {name: again[name] - count for name, count in found.items()} == {n: c // 2 for n, c in found.items()}
    assert row_files(tmp_path) == []
    assert not (tmp_path / "rows").exists()
    with pytest.raises(UserError, match="must have the records of attack=worlds alone, and has pessimist"):
        publish_worlds(ran(tmp_path / "other", drive(attack="pessimist")), tmp_path)
