"""The world `recorded`: traffic is what was recorded, reacts where it must, and a scene that is missing or unfit is one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from numpy.typing import NDArray

from cavbench.driving import Control
from cavbench.envs.highway.engine import Flag, Number
from cavbench.envs.recorded.axes import OWN_V1, RECORDED_V1, SCENES
from cavbench.envs.recorded.world import RecordedWorld
from cavbench.envs.roads.engine import RoadsEngine
from cavbench.envs.roads.replay import AWAY
from cavbench.envs.roads.state import Kind
from cavbench.errors import UserError
from cavbench.zoo.fetch import places
from tests.checks.rules import broken
from tests.command import Bench
from tests.envs.recorded.scenes import Road, platoon, scene, with_static

EPISODES = 12
SEEDS = np.arange(1_000_000, 1_000_000 + EPISODES)
LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER = range(5)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene with cars that brake one after the other, and a parked one."""
    place = tmp_path_factory.mktemp("scenes") / "braking.xml"
    road = Road()
    place.write_text(with_static(scene(road, platoon()), road, 280, 0))
    return place


def cell_of(world: RecordedWorld, **values: str) -> Any:
    return world.axes.cell(**{"scene": "own", **values})


def started(world: RecordedWorld, *, driver: str = "agent", **values: str) -> Any:
    control = Control(driver=driver)  # type: ignore[arg-type]
    engine = RoadsEngine(world.config((cell_of(world, **values),) * EPISODES, control))
    engine.reset(np.arange(EPISODES), SEEDS)
    return engine


def driven(world: RecordedWorld, action: int = IDLE, **values: str) -> Any:
    """The engine after whole episodes; `engine.sums` is the progress of each."""
    engine = started(world, **values)
    engine.sums = np.zeros(EPISODES)
    while not engine.flags[Flag.DONE].all():
        engine.step(np.full(EPISODES, action))
        engine.sums += engine.numbers[Number.PROGRESS]
    return engine


def scores(engine: Any) -> NDArray[np.float64]:
    failed = engine.flags[Flag.CRASHED] | engine.flags[Flag.OFFROAD]
    return np.where(failed, 0.0, engine.sums / engine.config.max_steps)


def due(engine: Any, row: int) -> NDArray[np.float64]:
    """[T, 4] where the recording has each road user at the current frame; NaN for those that are not there."""
    frame = int(engine.episodes["begin"][row] + engine.episodes["frames"][row])
    found = np.full((len(engine.recordings.tracks), 4), np.nan)
    for number, track in enumerate(engine.recordings.tracks):
        at = 0 if track["stands"] else frame - track["first"]
        if 0 <= at < track["count"]:
            found[number] = engine.recordings.frames[track["offset"] + at]
    return found


def test_replayed_cars_are_where_they_were_recorded(path: Path) -> None:
    engine = started(RecordedWorld(path=str(path)), traffic="replay")
    for action in [IDLE, SLOWER, LANE_LEFT, *[FASTER] * 40]:
        engine.step(np.full(EPISODES, action))
        for row in range(EPISODES):
            if engine.flags[Flag.DONE][row]:
                continue
            wanted, bodies = due(engine, row), engine.bodies[row, 1:]
            wanted[engine.episodes["taken"][row]] = np.nan
            there = np.isfinite(wanted[:, 0])
            assert (bodies["x"][~there] == AWAY).all()
            for column, name in enumerate(("x", "y", "heading", "speed")):
                np.testing.assert_array_equal(bodies[name][there], wanted[there, column])


def test_the_ego_starts_in_the_place_of_the_car_it_replaces(path: Path) -> None:
    engine = started(RecordedWorld(path=str(path)))
    for row in range(EPISODES):
        taken = engine.episodes["taken"][row]
        ego = engine.bodies[row, 0]
        assert (ego["x"], ego["y"], ego["heading"], ego["speed"]) == tuple(due(engine, row)[taken])
        assert engine.bodies[row, 1 + taken]["x"] == AWAY


def test_cars_react_only_where_the_ego_matters(path: Path) -> None:
    """Who drives like the recorded driver changes nothing; who brakes hard is followed by cars that brake, and not hit."""
    world = RecordedWorld(path=str(path))
    idm, braking, hit = (driven(world, SLOWER, traffic=traffic) for traffic in ("mixed", "mixed", "replay"))
    released = (braking.bodies["kind"][:, 1:] == Kind.IDM).sum(1)
    assert 0 < released.mean() < 6
    assert braking.flags[Flag.CRASHED].mean() < hit.flags[Flag.CRASHED].mean()
    # The same seeds give the same traffic.
    assert (idm.bodies["x"] == braking.bodies["x"]).all()


def test_a_car_that_was_not_released_is_still_where_it_was_recorded(path: Path) -> None:
    engine = driven(RecordedWorld(path=str(path)), SLOWER, traffic="mixed")
    for row in range(EPISODES):
        wanted, bodies = due(engine, row), engine.bodies[row, 1:]
        wanted[engine.episodes["taken"][row]] = np.nan
        replayed = (bodies["kind"] == Kind.RECORDED) & (bodies["x"] > AWAY)
        np.testing.assert_array_equal(bodies["x"][replayed], wanted[replayed, 0])
        # Nobody stands in the lanes where a recorded car drives on: those behind the ego were released.
        ego = engine.bodies[row, 0]
        behind = (
            replayed & (np.abs(bodies["y"] - ego["y"]) < 1.5) & (bodies["x"] < ego["x"]) & (bodies["x"] > ego["x"] - 5)
        )
        assert not behind.any()


def test_reactive_traffic_is_all_idm_and_parked_cars_stay(path: Path) -> None:
    engine = started(RecordedWorld(path=str(path)), traffic="reactive")
    parked = 1 + int(np.flatnonzero(engine.recordings.tracks["stands"])[0])
    where = engine.bodies["x"][:, parked].copy()
    for _ in range(10):
        engine.step(np.full(EPISODES, IDLE))
    kinds = engine.bodies["kind"][:, 1:]
    assert (kinds == Kind.IDM).mean() > 0.6
    assert (engine.bodies["x"][:, parked] == where).all()
    assert (engine.bodies["speed"] >= 0).all()


def test_the_recorded_driver_scores_one_and_who_stands_nothing(path: Path) -> None:
    """A car that covers the recorded metres has progress 1 in the mean; metres beyond them do not count."""
    engine = driven(RecordedWorld(path=str(path), change=0.0), FASTER, traffic="replay")
    engine_sums = engine.sums / engine.episodes["steps"]
    assert (engine.sums <= engine.config.max_steps + 1e-3).all()
    assert (engine_sums <= 1 + engine.episodes["arrived"] * 90).all()
    slow = driven(RecordedWorld(path=str(path), change=0.0), SLOWER, traffic="mixed")
    metres = slow.sums / 15 * slow.episodes["pace"]
    # The speed falls within a frame, whose metres are those of the speed before.
    assert (metres <= slow.episodes["driven"] + 1.5).all()
    assert scores(slow).max() < 0.3


def test_rules_see_what_a_blind_car_does_not(path: Path) -> None:
    world = RecordedWorld(path=str(path))
    engine = started(world, driver="idm")
    engine.sums = np.zeros(EPISODES)
    while not engine.flags[Flag.DONE].all():
        engine.step(np.full(EPISODES, IDLE))
        engine.sums += engine.numbers[Number.PROGRESS]
    ruled = scores(engine).mean()
    assert ruled > max(scores(driven(world, action)).mean() for action in (IDLE, FASTER, SLOWER))
    assert not engine.flags[Flag.CRASHED].any()


def test_an_episode_does_not_depend_on_the_batch(path: Path) -> None:
    world = RecordedWorld(path=str(path))
    chosen = [cell_of(world, traffic=traffic) for traffic in ("replay", "mixed", "reactive")]
    env, alone = world.make(chosen), world.make(chosen[1:2])
    seeds = torch.tensor([3, 4, 5])
    together, single = env.reset(env.reset().set("seed", seeds)), alone.reset(alone.reset().set("seed", seeds[1:2]))
    generator = torch.Generator().manual_seed(0)
    for _ in range(60):
        action = torch.randint(5, (3,), generator=generator)
        together = env.step(together.set("action", action))["next"]
        single = alone.step(single.set("action", action[1:2]))["next"]
        assert (together["observation"][1] == single["observation"][0]).all()


def test_weather_changes_what_is_seen_and_nothing_else(path: Path) -> None:
    world = RecordedWorld(path=str(path))
    engine = RoadsEngine(world.config([cell_of(world, weather=weather) for weather in ("clear", "fog")]))
    engine.reset(np.arange(2), np.array([9, 9]))
    for _ in range(30):
        engine.step(np.array([IDLE, IDLE]))
    assert (engine.bodies["x"][0] == engine.bodies["x"][1]).all()
    assert (engine.observation[0] != engine.observation[1]).any()


def test_facts_are_those_of_the_road(path: Path) -> None:
    world = RecordedWorld(path=str(path))
    facts = world.facts_at(cell_of(world))
    assert len(facts.lanes) == 3
    assert facts.kinematics is not None
    assert facts.kinematics.lane_width == pytest.approx(3.5, abs=1e-3)
    assert facts.kinematics.start_speed is None


def test_it_keeps_the_rules_of_bench_check(path: Path) -> None:
    assert broken("world", "recorded", path=str(path)) == {}


def test_a_run_attacks_a_driver_behind_filters_that_need_lanes(bench: Bench, path: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    said = bench(
        *("run", "world=recorded", f"world.path={path}", "episodes=1", "weather=clear", "traffic=mixed", f"out={out}"),
        *("victim=dqn", "seeds=0", "defense=tracker+shield", "attack=rehearse", "threat.access=dynamics"),
    )
    assert said.code == 0, said.err
    records = pq.read_table(out / "episodes").to_pylist()
    params = {json.loads(row["world_params"])["sha256"] for row in records}
    assert params == {RecordedWorld(path=str(path)).sha256}
    assert {json.loads(row["cell"])["scene"] for row in records} == {"own"}


def test_a_file_that_was_changed_is_refused(path: Path) -> None:
    with pytest.raises(ValueError, match=r"another file than world\.sha256"):
        RecordedWorld(path=str(path), sha256="0" * 64)


def test_scenes_that_were_not_fetched_are_one_line(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_CACHE", str(tmp_path))
    said = bench("run", "world=recorded", "victim=idm", "attack=none")
    assert said.code != 0
    assert said.err == "error: the scene us101_23_1 of world recorded is not here: `bench fetch ngsim` brings it\n"


def test_a_fetched_scene_with_other_content_is_refused(
    tmp_path: Path, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_CACHE", str(tmp_path))
    (tmp_path / SCENES["us101_23_1"]).write_bytes(path.read_bytes())
    with pytest.raises(UserError, match="it was changed"):
        RecordedWorld().doubts([RecordedWorld.home])


def test_every_scene_is_a_file_that_fetch_brings() -> None:
    assert set(SCENES.values()) == {path.name for path in places("ngsim")}


def test_a_start_is_a_scenario_and_further_seeds_repeat_them(path: Path) -> None:
    world = RecordedWorld(path=str(path))
    count = world.scenarios(cell_of(world))
    assert count is not None
    engine = RoadsEngine(world.config((cell_of(world),) * (count + 1), Control()))
    engine.reset(np.arange(count + 1), SEEDS[0] + np.arange(count + 1))
    starts = list(zip(engine.episodes["begin"].tolist(), engine.episodes["taken"].tolist(), strict=True))
    assert len(set(starts[:count])) == count
    assert starts[count] == starts[0]


def test_more_episodes_than_starts_are_refused(bench: Bench, path: Path) -> None:
    world = RecordedWorld(path=str(path))
    count = world.scenarios(cell_of(world))
    assert count is not None
    words = ("run", "world=recorded", f"world.path={path}", "victim=idm", "attack=none", f"episodes={count + 1}")
    said = bench(*words)
    assert said.code != 0
    assert len(said.err.strip().splitlines()) == 1
    assert f"episodes={count}, not {count + 1}" in said.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("scene=own",), "give it as world.path=FILE"),
        (("world.path=missing.xml",), "missing.xml cannot be read"),
        (("scene=us101_23_1", "world.path={path}"), "is the scene own"),
        (("world.path={path}", "world.max_steps=300"), "give a smaller world.max_steps"),
        (("world.path={path}", "world.change=25"), "changes its speed by 25 m/s"),
        (("world.path={path}", "traffic=replayed"), "did you mean 'replay'"),
        (("world.path={hostile}",), "it has a document type"),
        (("world.path={folder}",), "it is a folder, not a file"),
    ],
)
def test_what_cannot_be_driven_is_one_line(
    bench: Bench, path: Path, tmp_path: Path, words: tuple[str, ...], said: str
) -> None:
    hostile = tmp_path / "hostile.xml"
    hostile.write_text('<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><commonRoad>&b;</commonRoad>')
    given = [word.format(path=path, hostile=hostile, folder=tmp_path) for word in words]
    answer = bench("run", "world=recorded", "victim=idm", "attack=none", "episodes=1", *given)
    assert answer.code != 0
    assert said in answer.err
    assert len(answer.err.strip().splitlines()) == 1


def test_the_grids_have_the_cells_that_the_page_names() -> None:
    assert RecordedWorld().own_grid() is None
    assert len(RECORDED_V1.cells()) == 18
    assert len(OWN_V1.cells()) == 6
