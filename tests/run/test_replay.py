"""Any episode can be replayed from its record alone, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest

from cavbench.core.track import track
from cavbench.records import reading, store
from cavbench.records.schema import schema
from cavbench.run.replay import find, replay
from tests.cli.test_cli import TOY, assert_one_line
from tests.command import Said

Bench = Callable[..., Said]


def records_of(folder: Path) -> pa.Table:
    return reading.read(folder, track=track("driving"))


@pytest.fixture
def folder(bench: Bench, tmp_path: Path) -> Path:
    """The results of a small run, with a recording of one episode of each requested pair."""
    said = bench("run", *TOY, "attack.scale=0.5", "executor=serial", "reference=false", f"out={tmp_path}")
    assert said.code == 0, said.err
    assert "warning" not in said.err
    return tmp_path


def test_a_run_records_the_first_episode_of_each_requested_pair(folder: Path) -> None:
    (path,) = folder.glob("recordings/*/*.rrd")
    assert path.parent.name.startswith("nudge-none-toy-")
    assert path.name == "lanes-3-density-1-weather-clear-1000000.rrd"


def test_a_replay_reproduces_the_record(folder: Path) -> None:
    record = find(records_of(folder), {"attack": "nudge", "seed": "1000002"})
    again = replay(folder, record)
    assert (again.differences, again.changed) == ((), "")
    assert again.path.name == "lanes-3-density-1-weather-clear-1000002.rrd"
    assert again.path.stat().st_size > 0


def test_a_replay_that_differs_reports_the_differences_and_the_cause(folder: Path) -> None:
    records = records_of(folder)
    record = find(records, {"attack": "nudge"})
    rows = records.filter(pa.compute.field("unit") == record["unit"]).to_pylist()
    altered = [row | {"return": row["return"] + 1e-9, "code_digest": "another"} for row in rows]
    store.write(folder, pa.Table.from_pylist(altered, schema(track("driving"))))
    again = replay(folder, find(records_of(folder), {"attack": "nudge"}))
    assert (again.differences, again.changed) == (("return",), "code_digest")


def test_view_lists_recordings_and_records_other_episodes(bench: Bench, folder: Path) -> None:
    made = bench("view", "nudge", "lanes=3", "seed=1000003", "--out", str(folder))
    assert made.code == 0
    assert "Replayed bit for bit" in made.out
    listed = bench("view", str(folder))
    assert "has 2 recordings" in listed.out
    assert_one_line(bench("view", str(folder), "lanes=5"), "no record has lanes=5; known values: 3")
    assert_one_line(bench("view", str(folder), "lane=3"), "unknown column 'lane'; did you mean 'lanes'?")
    assert_one_line(bench("view", str(folder), "seed=first"), "cannot read seed=first: the column holds int64")
    assert_one_line(bench("view", "none", "--out", str(folder)), "has no recordings; record an episode")
