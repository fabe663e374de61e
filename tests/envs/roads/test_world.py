"""The worlds of road networks: what counts as progress, who fails, and that episodes do not depend on each other."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from cavbench.core import registry
from cavbench.driving import Control
from cavbench.envs.highway.engine import Flag, Number
from cavbench.envs.roads.engine import RoadsEngine
from cavbench.envs.roads.exit_world import ExitWorld
from cavbench.envs.roads.intersection_world import IntersectionWorld
from cavbench.envs.roads.merge_world import MergeWorld
from cavbench.envs.roads.racetrack_world import RacetrackWorld
from cavbench.envs.roads.roundabout_world import RoundaboutWorld
from cavbench.envs.roads.two_way_world import TwoWayWorld
from cavbench.envs.roads.u_turn_world import UTurnWorld
from cavbench.envs.roads.world import RoadsWorld
from cavbench.scenarios import Cell
from tests.command import Bench

ON_A_WAY = (RoundaboutWorld, IntersectionWorld, ExitWorld, UTurnWorld)
NEW = (*ON_A_WAY, TwoWayWorld, RacetrackWorld)
WORLDS = (*NEW, MergeWorld)
RULED = (IntersectionWorld, UTurnWorld, TwoWayWorld, RacetrackWorld)
"""Worlds whose rule-based driver finds its way; it does not look for an exit."""
ON_THE_RIGHT = ExitWorld.axes.cell(lanes=2, density=0.1)
EPISODES = 16
SEEDS = np.arange(1_000_000, 1_000_000 + EPISODES)
LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER = range(5)
each = pytest.mark.parametrize("kind", WORLDS, ids=lambda kind: kind.name)


def driven(world: RoadsWorld, cell: Cell, driver: str = "agent", action: int = IDLE) -> RoadsEngine:
    """The engine after sixteen whole episodes; `engine.sums` is the progress of each."""
    engine: Any = RoadsEngine(world.config((cell,) * EPISODES, Control(driver=driver)))  # type: ignore[arg-type]
    engine.reset(np.arange(EPISODES), SEEDS)
    engine.sums = np.zeros(EPISODES)
    while not engine.flags[Flag.DONE].all():
        engine.step(np.full(EPISODES, action))
        engine.sums += engine.numbers[Number.PROGRESS]
    return engine  # type: ignore[no-any-return]


def scores(engine: Any) -> NDArray[np.float64]:
    """Safe progress of each episode."""
    failed = engine.flags[Flag.CRASHED] | engine.flags[Flag.OFFROAD]
    return np.where(failed, 0.0, engine.sums / engine.config.max_steps)


@cache
def ruled(kind: type[RoadsWorld]) -> RoadsEngine:
    """Sixteen episodes of the rule-based driver in the world's own cell."""
    return driven(kind(), kind.home, "idm")


@pytest.mark.parametrize("kind", RULED, ids=lambda kind: kind.name)
def test_the_rule_based_driver_is_better_than_a_car_that_brakes_or_keeps_its_speed(kind: type[RoadsWorld]) -> None:
    blind = max(scores(driven(kind(), kind.home, action=action)).mean() for action in (IDLE, SLOWER))
    assert scores(ruled(kind)).mean() > blind


@pytest.mark.parametrize("kind", ON_A_WAY, ids=lambda kind: kind.name)
def test_the_steps_that_are_left_count_for_who_arrives(kind: type[RoadsWorld]) -> None:
    engine: Any = ruled(kind) if kind is not ExitWorld else driven(ExitWorld(), ON_THE_RIGHT, action=LANE_RIGHT)
    arrived, steps = engine.episodes["arrived"], engine.episodes["steps"]
    assert arrived.any()
    left = engine.config.max_steps - steps[arrived]
    assert (engine.sums[arrived] > left).all()
    assert (engine.sums <= engine.config.max_steps + 1e-3).all()
    assert (engine.flags[Flag.TERMINATED][arrived]).all()


@pytest.mark.parametrize("kind", ON_A_WAY, ids=lambda kind: kind.name)
def test_a_car_that_does_not_arrive_has_no_more_progress_than_it_has_driven(kind: type[RoadsWorld]) -> None:
    engine: Any = driven(kind(), kind.home, action=SLOWER)
    waits = ~(engine.episodes["arrived"] | engine.flags[Flag.CRASHED])
    metres = engine.sums * kind().config((kind.home,)).reference_speed / kind().policy_frequency
    # Lanes of a road differ in length, and a car is pushed by those that hit it.
    assert waits.any()
    assert (metres[waits] <= engine.episodes["driven"][waits] + 5).all()


def test_a_car_that_passes_its_exit_has_failed() -> None:
    engine: Any = driven(ExitWorld(), ExitWorld.home)
    assert engine.flags[Flag.OFFROAD].all()
    assert not engine.flags[Flag.CRASHED].any()
    assert scores(engine).max() == 0


@pytest.mark.parametrize("turn", ["right", "straight", "left"])
def test_a_car_of_the_roundabout_takes_the_exit_of_its_cell(turn: str) -> None:
    engine: Any = driven(RoundaboutWorld(), RoundaboutWorld.axes.cell(turn=turn, density=0.25))
    arrived = engine.episodes["arrived"]
    ego = engine.bodies[:, 0][arrived]
    assert arrived.mean() > 0.5
    place = {"right": ego["x"], "straight": -ego["y"], "left": -ego["x"]}[turn]
    assert (place > 40).all()


@each
def test_an_episode_does_not_depend_on_the_batch(kind: type[RoadsWorld]) -> None:
    world, cells = kind(), registry.grid_of(kind()).cells()
    chosen = [cells[0], cells[-1], kind.home]
    env, alone = world.make(chosen), world.make(chosen[1:2])
    seeds = torch.tensor([3, 4, 5])
    together, single = env.reset(env.reset().set("seed", seeds)), alone.reset(alone.reset().set("seed", seeds[1:2]))
    generator = torch.Generator().manual_seed(0)
    for _ in range(60):
        action = torch.randint(5, (3,), generator=generator)
        together = env.step(together.set("action", action))["next"]
        single = alone.step(single.set("action", action[1:2]))["next"]
        assert (together["observation"][1] == single["observation"][0]).all()
        if together["done"].any():
            break


@each
def test_weather_changes_what_is_seen_and_nothing_else(kind: type[RoadsWorld]) -> None:
    cells = [Cell(**{**kind.home, "weather": weather}) for weather in ("clear", "fog")]
    engine = RoadsEngine(kind().config(cells))
    engine.reset(np.arange(2), np.array([9, 9]))
    for _ in range(30):
        engine.step(np.array([IDLE, IDLE]))
    assert (engine.bodies["x"][0] == engine.bodies["x"][1]).all()
    assert (engine.observation[0] != engine.observation[1]).any()


@pytest.mark.parametrize("kind", NEW, ids=lambda kind: kind.name)
def test_a_denser_cell_has_more_cars(kind: type[RoadsWorld]) -> None:
    cells = registry.grid_of(kind()).cells()
    first, last = (kind().config((cell,) * EPISODES) for cell in (cells[0], cells[-1]))
    counts = []
    for config in (first, last):
        engine = RoadsEngine(config)
        engine.reset(np.arange(EPISODES), SEEDS)
        nearest = np.sort(np.hypot(*(engine.bodies[axis] - engine.bodies[axis][:, :1] for axis in "xy")), 1)
        counts.append((engine.episodes["cars"].mean(), -nearest[:, 1].mean()))
    assert counts[1] > counts[0]


@each
def test_facts_name_the_lanes_of_a_cell_and_records_do_not_hold_them(kind: type[RoadsWorld]) -> None:
    facts = kind().facts_at(kind.home)
    assert len(facts.lanes) > 1
    assert "lanes" not in facts.written()


@pytest.mark.parametrize("name", ["roundabout", "intersection", "racetrack"])
def test_what_needs_parallel_lanes_is_refused_in_one_line(bench: Bench, name: str) -> None:
    for words in ("defense=shield", "victim=planner"):
        said = bench("run", f"world={name}", words, "episodes=1", "attack=none")
        assert said.code != 0
        assert "kinematics" in said.err
        assert len(said.err.strip().splitlines()) == 1


def test_a_wrong_axis_is_one_line(bench: Bench) -> None:
    said = bench("run", "world=roundabout", "radius=5")
    assert said.code != 0
    assert "radius" in said.err
