"""What attackers know of road networks: beliefs and forecasts against the engine itself, and attacks that use them."""

from __future__ import annotations

from functools import cache
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cavbench.driving import Dynamics
from cavbench.envs.roads.exit_world import ExitWorld
from cavbench.envs.roads.foresight import RoadsDynamics
from cavbench.envs.roads.intersection_world import IntersectionWorld
from cavbench.envs.roads.merge_world import MergeWorld
from cavbench.envs.roads.roundabout_world import RoundaboutWorld
from cavbench.envs.roads.state import ViewKind
from cavbench.envs.roads.two_way_world import TwoWayWorld
from cavbench.envs.roads.world import RoadsWorld
from tests.command import Bench
from tests.envs.roads.forecasts import WORLDS, Errors, errors

EPISODES = 8
LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER = range(5)
MEDIAN = dict.fromkeys(WORLDS, 0.25)
"""Half of the other cars are foreseen to so many m after a second, in clear weather."""
MOST = dict.fromkeys(WORLDS, 1.6) | {"roundabout": 6.0}
"""Nine in ten of them; where nobody knows which exit a car takes, fewer."""
EGO = dict.fromkeys(WORLDS, 0.02) | {"exit": 3.6}
"""The ego's own place; before the exit an observation does not say where along the road it is."""
each = pytest.mark.parametrize("name", WORLDS)


@cache
def measured(name: str) -> Errors:
    return errors(WORLDS[name], episodes=EPISODES)


def started(world: RoadsWorld, episodes: int, seed: int = 0) -> tuple[Any, Any, Dynamics]:
    """An environment, its first observations, and its rules of motion."""
    cells = [world.home] * episodes
    env, dynamics = world.make(cells), world.dynamics(cells, "discrete")
    assert dynamics is not None
    return env, env.reset(env.reset().set("seed", torch.arange(seed, seed + episodes))), dynamics


@each
def test_forecasts_follow_the_engine_for_a_second(name: str) -> None:
    found = measured(name)
    assert found.ego.max() < EGO[name]
    assert found.ego_speed.max() < 1e-3
    assert np.median(found.others) < MEDIAN[name]
    assert np.quantile(found.others, 0.9) < MOST[name]


@each
def test_forecasts_are_better_than_keeping_the_velocity(name: str) -> None:
    found = measured(name)
    assert found.others.mean() < 0.7 * found.straight.mean()


def test_who_fails_within_a_second_is_foreseen() -> None:
    real, foreseen = np.concatenate([measured(name).failed for name in WORLDS]).T
    assert real.sum() > 10
    assert (foreseen & real).sum() >= 0.9 * real.sum()
    assert (foreseen & ~real).sum() <= 0.1 * real.sum()


@pytest.mark.parametrize("name", ["two_way", "exit", "roundabout"])
def test_the_targets_of_the_ego_follow_from_its_motion(name: str) -> None:
    @settings(max_examples=5, deadline=None)
    @given(seed=st.integers(0, 10**6), actions=st.lists(st.integers(0, 4), min_size=4, max_size=12))
    def follows(seed: int, actions: list[int]) -> None:
        env, now, dynamics = started(WORLDS[name], 2, seed)
        belief = dynamics.believe(now["observation"], dynamics.unknown())
        for action in actions:
            now = env.step(now.set("action", torch.full((2,), action)))["next"]
            belief = dynamics.believe(now["observation"], belief)
            running = ~now["done"][:, 0].numpy()
            ego = env.engine.bodies[np.arange(2), env.engine.episodes["ego"]]
            for field in ("target_speed", "target_lane"):
                np.testing.assert_array_equal(belief[field][running, 0].numpy(), ego[field][running])

    follows()


@each
def test_a_rehearsal_begins_with_what_is_seen(name: str) -> None:
    _, now, dynamics = started(WORLDS[name], 4)
    rehearsal = dynamics.rehearsal(dynamics.believe(now["observation"], dynamics.unknown()), 3)
    seen, wanted = rehearsal.observation, now["observation"].expand(3, -1, -1, -1)
    # Cars beyond the range of a place cannot be placed.
    inside = (wanted[..., 1:3].abs() < 1).all(-1) & (wanted[..., 0] > 0) & (wanted[..., 3:].abs() < 1).all(-1)
    inside[..., 0] = False
    assert inside.any()
    torch.testing.assert_close(seen[inside], wanted[inside], atol=2e-3, rtol=0)


def test_a_belief_depends_on_observations_alone() -> None:
    env, now, dynamics = started(MergeWorld(), EPISODES)
    belief = dynamics.believe(now["observation"], dynamics.unknown())
    env.engine.bodies["target_speed"] = 3.0
    assert (dynamics.believe(now["observation"], dynamics.unknown()) == belief).all()
    rows = torch.tensor([5, 2])
    plans = torch.tensor([[IDLE] * 20, [LANE_LEFT] * 20])
    assert (dynamics.roll(belief[rows], plans).failed == dynamics.roll(belief, plans).failed[rows]).all()


def test_the_end_of_the_ramp_is_an_obstacle_of_the_forecast() -> None:
    _, now, dynamics = started(MergeWorld(), 1)
    assert isinstance(dynamics, RoadsDynamics)
    bodies, episodes = dynamics.placed(dynamics.believe(now["observation"], dynamics.unknown()))
    cars = episodes["cars"][0]
    assert episodes["bodies"][0] == cars + 1
    assert (bodies[0, cars]["length"], bodies[0, cars]["speed"]) == (2.0, 0.0)


def test_oncoming_cars_are_believed_to_come_even_beyond_the_range_of_velocities() -> None:
    world = TwoWayWorld()
    env, now, dynamics = started(world, EPISODES)
    belief, checked = dynamics.believe(now["observation"], dynamics.unknown()), 0
    for step in range(140):
        action = torch.full((EPISODES,), IDLE if step else LANE_LEFT)
        now = env.step(now.set("action", action))["next"]
        belief = dynamics.believe(now["observation"], belief)
        beyond = (now["observation"][:, 1:, 3] == -1).any(-1) & ~now["done"][:, 0]
        for one in beyond.nonzero()[:, 0].tolist() if step > 130 else ():
            real = env.engine.bodies[one]
            for car in ((belief["heading"][one].cos() < 0) & (belief["speed"][one] > 0)).nonzero()[:, 0].tolist():
                place = belief["x"][one, car].item()
                if place - belief["x"][one, 0].item() > 70:
                    # Half a second in view says how fast it is.
                    continue
                own = real[np.abs(real["x"] - place).argmin()]
                assert abs(own["speed"] - belief["speed"][one, car].item()) < 2.0
                checked += 1
    assert checked > 0


def test_who_arrives_counts_no_more_than_a_whole_plan() -> None:
    _, now, dynamics = started(IntersectionWorld(), EPISODES)
    forecast = dynamics.roll(dynamics.believe(now["observation"], dynamics.unknown()), torch.full((1, 299), FASTER))
    assert ((forecast.progress >= 0) & (forecast.progress <= 299)).all()
    assert (forecast.failed == 299).any()


def test_continuous_plans_are_forecast_too() -> None:
    cells = [RoundaboutWorld.home] * EPISODES
    env, dynamics = (
        RoundaboutWorld().make(cells, action_type="continuous"),
        RoundaboutWorld().dynamics(cells, "continuous"),
    )
    assert dynamics is not None
    belief = dynamics.believe(
        env.reset(env.reset().set("seed", torch.arange(EPISODES)))["observation"], dynamics.unknown()
    )
    straight, off = torch.zeros(30, 2), torch.tensor([0.0, 1.0]).expand(30, 2)
    forecast = dynamics.roll(belief, torch.stack([straight, off]))
    assert (forecast.failed[:, 1] < 30).all()
    assert forecast.failed[:, 0].float().mean() > forecast.failed[:, 1].float().mean()


def test_a_world_that_observes_a_grid_has_no_dynamics() -> None:
    class Grid(ExitWorld):
        rules: ClassVar[dict[str, Any]] = {**ExitWorld.rules, "view": ViewKind.OCCUPANCY}

    assert Grid().dynamics([Grid.home], "discrete") is None


@pytest.mark.slow
@pytest.mark.parametrize("attack", ["plan", "rehearse"])
def test_planning_attacks_run_from_the_command_line(bench: Bench, attack: str) -> None:
    words = ("world=two_way", "victim=dqn", f"attack={attack}", "threat.access=dynamics", "density=1", "oncoming=1")
    said = bench("run", *words, "weather=clear", "episodes=2", "seeds=0", "reference=false", "record=0")
    assert (said.code, attack in said.out) == (0, True), said.err
