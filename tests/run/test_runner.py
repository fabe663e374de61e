"""A run: its units, its results, which depend only on its configuration, and its resumption."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timedelta, tzinfo
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pytest

from cavbench.core import progress, registry
from cavbench.core.track import track
from cavbench.errors import Notice, UnfinishedError, UserError
from cavbench.records import reading
from cavbench.records.schema import PROBES
from cavbench.run import runner
from cavbench.run.config import plan_of
from cavbench.run.task import Task
from tests.command import Said
from tests.plugins.distributions import install

pytestmark = pytest.mark.usefixtures("toy_folder")

SMALL = "attack=nudge victim=toy world=toy lanes=3,4 density=1 weather=clear,fog episodes=4 seeds=0,1"
BESIDE = ("attack_ms", "created_at", "wall_s", *(field.name for field in PROBES))
"""Columns in which two runs of the same unit may differ; nobody can foresee which moments are probed."""


class Silent:
    """A watcher that stores what it receives, and can stop the run."""

    def __init__(self, stop_after: int | None = None) -> None:
        self.done: list[Task] = []
        self.told: list[tuple[str, float, str]] = []
        self.shares: list[tuple[float, int]] = []
        self.warnings: list[str] = []
        self.failures: list[str] = []
        self.said: list[str] = []
        self.stop_after = stop_after

    def begin(self, *, episodes: int, finished: int, forecast: object) -> None:
        self.episodes, self.there = episodes, finished

    def working(self, tasks: Sequence[Task]) -> None:
        if len(self.done) == self.stop_after:
            raise KeyboardInterrupt

    def preparing(self, task: str, share: float, text: str, episodes: int = 0) -> None:
        if episodes:
            self.shares.append((share, episodes))
        else:
            self.told.append((task, share, text))

    def finished(self, task: Task, wall_s: float) -> None:
        self.done.append(task)

    def failed(self, line: str) -> None:
        self.failures.append(line)

    def printed(self, task: object, lines: Sequence[str]) -> None:
        self.said += lines

    def warn(self, line: str) -> None:
        self.warnings.append(line)


def run(out: Path, *more: str, line: str = SMALL, watcher: Silent | None = None) -> tuple[pa.Table, Silent]:
    words = dict(word.split("=", 1) for word in [*line.split(), "executor=serial", f"out={out}", "record=0", *more])
    config = plan_of([f"{key}={value}" for key, value in words.items()])
    watcher = watcher or Silent()
    return reading.read(out, runner.run(config, watcher), track=track("driving")), watcher


def comparable(records: pa.Table) -> pa.Table:
    return records.drop_columns(list(BESIDE))


def test_a_unit_says_how_far_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "EVERY_S", 0.0)
    _, watcher = run(tmp_path, "lanes=3", "weather=clear", "seeds=0", "reference=false")
    shares = [share for share, _ in watcher.shares]
    assert shares
    assert 0 <= min(shares) < max(shares) < 1
    assert {episodes for _, episodes in watcher.shares} == {4}


def test_a_run_has_the_pair_its_clean_control_and_the_reference_drivers(tmp_path: Path) -> None:
    records, watcher = run(tmp_path)
    rows = records.to_pylist()
    attacked = [row for row in rows if row["attack"] == "nudge"]
    clean = [row for row in rows if row["attack"] == "none" and row["victim"] == "toy"]
    reference = [row for row in rows if not row["sees"]]
    assert len(attacked) == len(clean) == 2 * 2 * 2 * 4
    assert {row["threat_budget"] for row in clean} == {0.0}
    assert {row["training_seed"] for row in attacked} == {0, 1}
    assert {row["victim"] for row in reference} == {"blind", "random"}
    assert len({row["pair"] for row in reference}) == 6 + 1
    assert {json.loads(row["cell"])["weather"] for row in reference} == {"clear"}
    assert {row["training_seed"] for row in reference} == {0}
    assert watcher.episodes == records.num_rows


def test_all_pairs_drive_the_same_scenarios(tmp_path: Path) -> None:
    records, _ = run(tmp_path)
    cells: dict[str, set[tuple[int, int]]] = {}
    for row in records.to_pylist():
        cells.setdefault(row["pair"], set()).add((json.loads(row["cell"])["lanes"], row["seed"]))
    assert len(set(map(frozenset, cells.values()))) == 1


def test_two_pairs_share_their_clean_control(tmp_path: Path) -> None:
    config = plan_of([*SMALL.replace("attack=nudge", "attack=nudge,noise").split(), "threat.budget=0.1,0.2"])
    clean = [unit for unit in config.units() if unit.pair.is_clean and unit.pair.victim.name == "toy"]
    assert len(config.pairs) == 4
    assert len(clean) == 2 * 2 * 2


def test_baselines_can_be_switched_off(tmp_path: Path) -> None:
    records, _ = run(tmp_path, "reference=false")
    assert all(records["sees"].to_pylist())


def test_continuous_victims_have_continuous_baselines() -> None:
    config = plan_of(["attack=veer", "victim=toy", "victim.actions=continuous", "world=toy"])
    kinds = {(unit.pair.victim.name, unit.pair.victim.component.action_type) for unit in config.units()}
    assert kinds == {("toy", "continuous"), ("blind", "continuous"), ("random", "continuous")}


@pytest.mark.slow
def test_results_do_not_depend_on_the_executor_nor_on_the_number_of_workers(tmp_path: Path) -> None:
    one, _ = run(tmp_path / "one", "reference=false", "executor=serial", "workers=3")
    three, _ = run(tmp_path / "three", "reference=false", "executor=processes", "workers=3")
    assert comparable(one).equals(comparable(three))


def test_results_do_not_depend_on_what_else_is_run(tmp_path: Path) -> None:
    alone, _ = run(tmp_path / "alone", "reference=false", "seeds=1", line=SMALL)
    among, _ = run(tmp_path / "among")
    units = set(alone["unit"].to_pylist())
    assert units <= set(among["unit"].to_pylist())
    assert comparable(alone).equals(comparable(reading.read(tmp_path / "among", units, track=track("driving"))))


def test_a_finished_run_does_nothing(tmp_path: Path) -> None:
    first, _ = run(tmp_path)
    again, watcher = run(tmp_path)
    assert watcher.done == []
    assert watcher.there == watcher.episodes
    assert again.equals(first)


def test_an_interrupted_run_keeps_finished_units_and_continues(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "broken-off", watcher=Silent(stop_after=3))
    assert reading.read(tmp_path / "broken-off", track=track("driving")).num_rows == 3 * 4
    went_on, watcher = run(tmp_path / "broken-off")
    whole, _ = run(tmp_path / "whole")
    assert watcher.there == 3 * 4
    assert comparable(went_on).equals(comparable(whole))


def test_a_grid_in_blocks_drives_the_same_episodes_and_the_first_block_of_every_cell_first(tmp_path: Path) -> None:
    whole = plan_of([*SMALL.split(), "executor=serial", f"out={tmp_path / 'whole'}", "record=0"])
    blocks = replace(whole, grid=replace(whole.grid, block=2), out=tmp_path / "blocks")
    watcher = Silent()
    runner.run(blocks, watcher)
    runner.run(whole, Silent())
    order = [(name, "ascending") for name in ("pair", "training_seed", "cell", "seed")]

    def clean(out: Path) -> pa.Table:
        records = reading.read(out, track=track("driving"))
        return comparable(records).filter(pc.equal(records["attack"], "none")).drop("unit").sort_by(order)

    assert clean(blocks.out).equals(clean(whole.out))
    starts = [task.unit.seeds.start for task in watcher.done]
    assert starts == sorted(starts)
    assert len(set(starts)) == 2
    shards = [replace(blocks, shard=(part, 3)).units() for part in (1, 2, 3)]
    assert sum(map(len, shards)) == len({unit.fingerprint for units in shards for unit in units}) == len(starts)


def test_a_failing_attack_is_reported_with_its_cell_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError) as raised:
        run(tmp_path, "attack.mood=raise")
    assert "nudge(mood=raise) + none + toy | lanes 4, density 1, clear" in str(raised.value)
    assert "ZeroDivisionError: the attack is at a loss" in str(raised.value)


@pytest.mark.slow
def test_a_worker_that_is_killed_is_reported_and_loses_no_finished_unit(tmp_path: Path) -> None:
    calm, _ = run(tmp_path, "reference=false")
    deadly = ("attack.mood=calm,kill", "executor=processes", "workers=2", "reference=false")
    with pytest.raises(
        UnfinishedError, match=r"ended its worker process \(SIGKILL.*of cavbench-toy 1.0.* more were not driven"
    ):
        run(tmp_path, *deadly)
    kept, watcher = run(tmp_path, "reference=false")
    assert watcher.done == []
    assert kept.equals(calm)


def test_a_missing_policy_is_reported_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    watcher = Silent()
    with pytest.raises(UserError, match="bench train"):
        run(tmp_path, "seeds=977", line="victim=dqn world=toy lanes=3 density=1 episodes=2", watcher=watcher)
    assert watcher.done == []


def test_a_record_names_its_grid_only_if_cell_and_seeds_match() -> None:
    whole = plan_of(["victim=toy", "world=toy", "lanes=3"]).units()
    short = plan_of(["victim=toy", "world=toy", "lanes=3", "episodes=99"]).units()
    other = plan_of(["victim=toy", "world=toy", "lanes=2"]).units()
    as_few_as_approaches = plan_of(["victim=toy", "world=toy", "lanes=3", "episodes=3"]).units()
    assert {unit.grid for unit in whole} == {"toy-v1"}
    assert {unit.grid for unit in (*short, *other, *as_few_as_approaches)} == {"custom"}


def test_a_block_of_a_grid_has_its_name() -> None:
    words = ["attack=noise", "victim=dqn", "grid=standard-v2", "reference=false", "seeds=0"]
    assert {unit.grid for unit in plan_of([*words, "lanes=3", "episodes=20"]).units()} == {"standard-v2"}
    assert {unit.grid for unit in plan_of([*words, "lanes=3", "episodes=15"]).units()} == {"custom"}


def test_a_unit_in_which_an_attack_changed_the_victim_is_refused_with_its_package(
    bench: Callable[..., Said], plugins: Path, tmp_path: Path
) -> None:
    code = """
import gc
from dataclasses import dataclass
from typing import ClassVar

from cavbench.driving import DrivingAttack, Policy


@dataclass(frozen=True, kw_only=True)
class Poison(DrivingAttack):
    access: ClassVar[str] = "oblivious"

    def perturb(self, observation, oracle):
        for one in gc.get_objects():
            if isinstance(one, Policy):
                for buffer in one.buffers():
                    buffer.mul_(0.5)
        return observation
"""
    install(plugins, "cavbench-poison", {"cavbench.attacks": {"poison": "poison:Poison"}}, {"poison": code}, "2.1")
    registry.installed.cache_clear()
    out = tmp_path / "results"
    words = (
        "attack=poison",
        "victim=toy",
        "world=toy",
        "lanes=3",
        "density=1",
        "weather=clear",
        "episodes=2",
        "seeds=0",
    )
    said = bench("run", *words, "executor=serial", "reference=false", f"out={out}")
    assert said.code == 2
    last = said.err.strip().splitlines()[-1]
    assert "is refused: the attack changed the victim's weights (attack 'poison' of cavbench-poison 2.1)" in last
    kept = reading.read_all(out)["driving"] if list(out.glob("episodes/*.parquet")) else None
    assert kept is None or set(kept["attack"].to_pylist()) == {"none"}


def test_shards_drive_every_unit_once(tmp_path: Path) -> None:
    whole, _ = run(tmp_path / "whole")
    parts = [run(tmp_path / "parts", f"shard={part}/3")[1].done for part in (1, 2, 3)]
    units = [task.unit.fingerprint for done in parts for task in done]
    assert sorted(units) == sorted(set(whole["unit"].to_pylist()))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    merged = reading.read(tmp_path / "parts", set(units), track=track("driving"))
    assert comparable(merged).equals(comparable(whole))


@pytest.mark.parametrize("shard", ["0/3", "4/3", "1", "a/b"])
def test_a_shard_that_there_is_not_is_refused(shard: str) -> None:
    with pytest.raises(UserError, match="shard must be PART/PARTS"):
        plan_of([*SMALL.split(), f"shard={shard}"])


def test_a_clock_that_jumps_during_a_run_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It jumps before every unit: a day ahead, three years back, a year ahead, and back to the time of day."""
    steady, _ = run(tmp_path / "steady")
    jumps = itertools.cycle(timedelta(days=days) for days in (1, -1100, 365, 0))

    class Jumping(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:
            return datetime.now(tz) + next(jumps)

    known = time.time
    monkeypatch.setattr("cavbench.run.unit.datetime", Jumping)
    monkeypatch.setattr(time, "time", lambda: known() + next(jumps).total_seconds())
    with pytest.warns(Notice, match="dated in the future"):
        jumped, _ = run(tmp_path / "jumped")
    with pytest.warns(Notice, match="dated in the future"):
        again, watcher = run(tmp_path / "jumped")
    assert comparable(jumped).drop_columns("unit").equals(comparable(steady).drop_columns("unit"))
    assert again.equals(jumped)
    assert watcher.done == []
    assert watcher.there == watcher.episodes
