"""What attackers know of recorded roads: the ego's motion exactly, the others as they are seen, and nothing that was recorded."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from cavbench.envs.recorded.foresight import RecordedDynamics
from cavbench.envs.recorded.world import RecordedWorld
from cavbench.envs.roads.recordings import NOTHING
from tests.envs.recorded.scenes import Road, platoon, scene

EPISODES, SEEDS = 6, torch.arange(6)
LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER = range(5)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> RecordedWorld:
    place = tmp_path_factory.mktemp("scenes") / "braking.xml"
    place.write_text(scene(Road(), platoon()))
    return RecordedWorld(path=str(place))


def started(world: RecordedWorld) -> tuple[Any, Any, Any]:
    """An environment, its first observations, and its rules of motion."""
    cells = [world.axes.cell(scene="own")] * EPISODES
    env = world.make(cells)
    dynamics = world.dynamics(cells, "discrete")
    assert isinstance(dynamics, RecordedDynamics)
    return env, env.reset(env.reset().set("seed", SEEDS)), dynamics


def test_the_targets_of_the_ego_follow_from_its_motion(world: RecordedWorld) -> None:
    env, now, dynamics = started(world)
    belief = dynamics.believe(now["observation"], dynamics.unknown())
    for action in (SLOWER, IDLE, LANE_RIGHT, FASTER, IDLE):
        now = env.step(now.set("action", torch.full((EPISODES,), action)))["next"]
        belief = dynamics.believe(now["observation"], belief)
        running = ~now["done"][:, 0].numpy()
        np.testing.assert_array_equal(belief["target_speed"][running, 0], env.engine.bodies["target_speed"][running, 0])


def test_a_rehearsal_begins_with_what_is_seen(world: RecordedWorld) -> None:
    _, now, dynamics = started(world)
    belief = dynamics.believe(now["observation"], dynamics.unknown())
    rehearsal = dynamics.rehearsal(belief, 3)
    assert rehearsal.observation.shape == (3, *now["observation"].shape)
    torch.testing.assert_close(rehearsal.observation, now["observation"].expand(3, -1, -1, -1), atol=1e-4, rtol=0)


def test_the_ego_moves_in_a_rehearsal_as_it_does(world: RecordedWorld) -> None:
    env, now, dynamics = started(world)
    rehearsal = dynamics.rehearsal(dynamics.believe(now["observation"], dynamics.unknown()), 1)
    for action in (SLOWER, LANE_RIGHT, IDLE, FASTER):
        chosen = torch.full((EPISODES,), action)
        rehearsal.step(chosen[None])
        now = env.step(now.set("action", chosen))["next"]
    running = ~(now["done"][:, 0] | rehearsal.failed[0])
    assert running.any()
    # Clipped places are not known, so x may be off.
    seen, wanted = rehearsal.observation[0, running, 0, 2:], now["observation"][running, 0, 2:]
    torch.testing.assert_close(seen, wanted, atol=1e-3, rtol=0)


def test_a_forecast_says_who_drives_into_a_car_ahead(world: RecordedWorld) -> None:
    _, now, dynamics = started(world)
    belief = dynamics.believe(now["observation"], dynamics.unknown())
    plans = torch.stack([torch.full((60,), action) for action in (FASTER, SLOWER)])
    forecast = dynamics.roll(belief, plans)
    assert forecast.failed.shape == (EPISODES, 2)
    # All have a car ahead at 30 m or less but those at the front.
    assert forecast.crashed[:, 0].float().mean() > 0.5
    assert (forecast.failed[:, 1] >= forecast.failed[:, 0]).all()
    assert ((forecast.progress >= 0) & (forecast.progress <= 60)).all()
    again = dynamics.roll(belief[2:4], plans)
    assert (again.failed == forecast.failed[2:4]).all()


def test_continuous_plans_are_forecast_too(world: RecordedWorld) -> None:
    cells = [world.axes.cell(scene="own")] * EPISODES
    env = world.make(cells, action_type="continuous")
    dynamics = world.dynamics(cells, "continuous")
    belief = dynamics.believe(env.reset(env.reset().set("seed", SEEDS))["observation"], dynamics.unknown())
    straight, off = torch.zeros(30, 2), torch.tensor([0.0, 1.0]).expand(30, 2)
    forecast = dynamics.roll(belief, torch.stack([straight, off]))
    assert (forecast.failed[:, 1] < 30).all()
    assert forecast.failed[:, 0].float().mean() > forecast.failed[:, 1].float().mean()


def test_nothing_that_was_recorded_is_known(world: RecordedWorld) -> None:
    _, _, dynamics = started(world)
    assert {id(one.recordings) for one in dynamics.config.scenes} == {id(NOTHING)}
    assert np.isinf(dynamics.roads["end"]).all()
