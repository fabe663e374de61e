"""What an attacker rehearses is how the platoon moves, as long as the car ahead keeps its command."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cavbench.driving import Control
from cavbench.envs.platoon.engine import PlatoonEngine
from cavbench.envs.platoon.world import PlatoonWorld


def test_a_rehearsal_goes_on_as_the_world_does() -> None:
    world = PlatoonWorld(noise=0.0)
    cells = [world.axes.cell(place=1, cycle="motorway")] * 2
    engine = PlatoonEngine(world.configuration(cells, Control(action_type="continuous")))
    engine.reset(np.arange(2), np.array([3, 4]))
    engine.platoons.leader[:] = -1.5
    actions = torch.tensor([[0.1], [-0.4]])
    for _ in range(20):
        engine.step(actions.numpy())
    seen = torch.from_numpy(engine.observation.copy())
    dynamics = world.dynamics(cells, "continuous")
    rehearsal = dynamics.rehearsal(dynamics.believe(seen, dynamics.unknown()), 3)
    for _ in range(10):
        engine.step(actions.numpy())
        rehearsal.step(actions.expand(3, 2, 1))
        platoons = engine.platoons
        assert rehearsal.gap[1] == pytest.approx(platoons.x[:, 0] - platoons.x[:, 1] - 5, abs=0.01)
        assert rehearsal.observation[0, :, 0] == pytest.approx(torch.from_numpy(engine.observation[:, 0]), abs=1e-4)
        assert rehearsal.progress[2] == pytest.approx(engine.numbers[:, 1], abs=1e-3)


def test_a_plan_that_hits_the_car_ahead_fails_and_braking_does_not() -> None:
    world = PlatoonWorld()
    cells = [world.axes.cell(place=2, cycle="wave")]
    engine = PlatoonEngine(world.configuration(cells, Control()))
    engine.reset(np.array([0]), np.array([1]))
    dynamics = world.dynamics(cells, "discrete")
    belief = dynamics.believe(torch.from_numpy(engine.observation.copy()), dynamics.unknown())
    plans = torch.stack((torch.full((80,), 4), torch.zeros(80, dtype=torch.int64)))
    forecast = dynamics.roll(belief, plans)
    assert forecast.crashed.tolist() == [[True, False]]
    assert int(forecast.failed[0, 0]) < 80 == int(forecast.failed[0, 1])
