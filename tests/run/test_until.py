"""`until=`: scenarios are driven in rounds until a row is known, with an interval that stays valid under looking."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cavbench.core.track import track
from cavbench.errors import UnfinishedError, UserError
from cavbench.records import reading
from cavbench.run import rounds, runner, stops
from cavbench.run.audit import audit_of
from cavbench.run.config import plan_of
from cavbench.run.plan import SCENARIOS, Plan
from cavbench.run.replay import repeat
from cavbench.statistics.sequential import confidence_sequence, shown_higher
from tests.run.test_runner import Silent, comparable
from tests.statistics.simulated_stops import SCORES, studied

pytestmark = pytest.mark.usefixtures("toy_folder")

WORDS = (
    *("attack=nudge", "victim=toy", "world=toy", "lanes=3,4", "density=1", "weather=clear", "seeds=0,1", "episodes=60"),
    *("reference=false", "executor=serial", "record=0", "until=0.15"),
)


def config(out: Path, *more: str) -> Plan:
    words = dict(word.split("=", 1) for word in (*WORDS, *more))
    return plan_of([*(f"{key}={value}" for key, value in words.items()), f"out={out}"])


@pytest.mark.parametrize("name", list(SCORES))
def test_the_interval_holds_at_every_look_as_often_as_it_says(name: str) -> None:
    found = studied(name, 0.05, 200)
    assert found.always >= 0.95 - 3 * np.sqrt(0.05 * 0.95 / 200)
    assert found.always <= found.at_stop
    assert found.scenarios <= 100


def test_the_interval_moves_inwards_and_becomes_narrow() -> None:
    low, high = confidence_sequence(np.random.default_rng(0).beta(8, 12, (3, 400)), width=0.02, most=400)
    assert (np.diff(low) >= 0).all()
    assert (np.diff(high) <= 0).all()
    assert (high - low)[:, -1].max() < 0.06


def test_a_difference_that_is_not_there_is_seldom_shown() -> None:
    rng = np.random.default_rng(0)
    assert shown_higher(rng.beta(2, 2, (2000, 100)), 0.05).mean() < 0.05
    assert shown_higher(rng.beta(3, 2, (2000, 100)), 0.05).mean() > 0.9


def test_an_attack_that_cannot_be_the_strongest_is_ruled_out_and_the_strongest_hardly_ever(tmp_path: Path) -> None:
    asked = config(tmp_path, "attack.scale=0.1,0.2,1.0", "until=0.01")
    rng, ruled_out = np.random.default_rng(0), 0
    for _ in range(10):
        rows = [rounds.Row(pair, 0.01, asked.grid.episodes) for pair in asked.pairs]
        traffic = rng.random((2, 2, 60))
        for row, score in zip(rows, (0.6, 0.2, 0.2), strict=True):
            own = np.clip(0.3 * traffic + score + 0.1 * rng.standard_normal(traffic.shape), 0, 1)
            row.parts = list(np.split(own, 6, -1))
        rounds.look(rows)
        weak, *strong = rows
        assert weak.stop is not None
        assert weak.stop.why == "ruled out"
        assert set(weak.stop.by) <= {row.pair.id for row in strong}
        ruled_out += any(row.stop is not None for row in strong)
    assert ruled_out <= 2


def test_a_run_stops_when_its_row_is_known_and_says_where(tmp_path: Path) -> None:
    asked = config(tmp_path)
    units = runner.run(asked, Silent())
    (stop,) = stops.read(tmp_path, [pair.id for pair in asked.pairs])
    records = reading.read(tmp_path, units, track=track("driving"))
    assert set(records["grid"].to_pylist()) == {"sequential"}
    assert stop.why == "narrow"
    assert SCENARIOS <= stop.scenarios < stop.most == 60
    assert len(set(records["seed"].to_pylist())) == stop.scenarios
    assert stop.high - stop.low <= 2 * 0.15
    attacked = [row["safe_progress"] for row in records.to_pylist() if row["attack"] == "nudge"]
    assert stop.estimate == pytest.approx(np.mean(attacked))
    assert stop.low <= stop.estimate <= stop.high
    controls = [row for row in records.to_pylist() if row["attack"] == "none"]
    assert len(controls) == len(attacked)
    again = Silent()
    assert runner.run(asked, again) == units
    assert again.done == []
    repeated = repeat(tmp_path, records.slice(0, 1).to_pylist()[0])
    assert (repeated.changed, repeated.differences) == ("", ())


def test_a_run_that_was_killed_stops_where_it_would_have(tmp_path: Path) -> None:
    whole = runner.run(config(tmp_path / "whole"), Silent())
    with pytest.raises(KeyboardInterrupt):
        runner.run(config(tmp_path / "killed"), Silent(stop_after=6))
    assert runner.run(config(tmp_path / "killed"), Silent()) == whole
    first, second = (reading.read(tmp_path / name, whole, track=track("driving")) for name in ("whole", "killed"))
    assert comparable(first).equals(comparable(second))
    stops = [json.loads(next((tmp_path / name / "stops").iterdir()).read_bytes()) for name in ("whole", "killed")]
    assert stops[0] == stops[1]


def test_a_grid_that_is_done_stops_a_row(tmp_path: Path) -> None:
    asked = config(tmp_path, "until=0.001", "episodes=15")
    runner.run(asked, Silent())
    (stop,) = stops.read(tmp_path, [asked.pairs[0].id])
    assert (stop.why, stop.scenarios, stop.most) == ("grid done", 15, 15)


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ("until=0", "until must be between 0.001 and 0.5"),
        ("until=nan", "until must be between 0.001 and 0.5"),
        ("shard=1/2", "leave out shard, or leave out until"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, more: str, why: str) -> None:
    with pytest.raises(UserError, match=why):
        config(tmp_path, more)


def test_fixed_scenarios_and_audits_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="has a fixed set of scenarios: leave out until"):
        plan_of(["victim=yolov3_tiny", "attack=grey_patch", "until=0.1", f"out={tmp_path}"])
    with pytest.raises(UserError, match="leave out until"):
        audit_of([*WORDS, f"out={tmp_path}"])


def test_a_pair_that_fails_has_stopped_and_the_others_go_on_as_without_it(tmp_path: Path) -> None:
    runner.run(config(tmp_path / "alone"), Silent())
    asked = config(tmp_path / "both", "attack.mood=calm,raise")
    alone = stops.read(tmp_path / "alone", [asked.pairs[0].id])
    for resumed in (False, True):
        watcher = Silent()
        with pytest.raises(UnfinishedError):
            runner.run(asked, watcher)
        calm, failed = stops.read(tmp_path / "both", [pair.id for pair in asked.pairs])
        assert [calm] == alone
        assert (failed.why, failed.scenarios) == ("failed", 0)
        assert bool(watcher.done) is not resumed
        assert watcher.failures
