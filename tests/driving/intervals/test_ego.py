"""Dead reckoning of the own car is exact, whatever is shown."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from cavbench.driving import ObservationThreat
from cavbench.driving.intervals.boxes import Assumed
from cavbench.driving.intervals.policy import reckoning
from tests.driving.intervals.drivers import FACTS, SEEDS, WORLD, roads


def test_dead_reckoning_is_exact_whatever_is_shown() -> None:
    env = roads(WORLD, lanes=4)
    moves, generator = reckoning(FACTS, "discrete"), torch.Generator().manual_seed(0)
    assumed = Assumed(FACTS.features, "relative", 0.1)
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    state = moves.unknown(torch.tensor(SEEDS))
    compared = 0
    for step in range(90):
        truth, running = td["observation"], ~td["done"].squeeze(-1)
        radius = ObservationThreat().radius(truth, FACTS.features)
        shown = truth + radius * (2 * torch.rand(truth.shape, generator=generator) - 1)
        ego = moves.now(assumed.boxes(shown), state)
        on_road = running & (ego.edge < 64) if step > 60 else running & (ego.target_lane < 4)
        cars = env.engine.vehicles[:, 0]
        y = torch.from_numpy(cars["y"].copy())[on_road]
        torch.testing.assert_close(ego.y[on_road].double(), y, atol=2e-3, rtol=0)
        speed = torch.from_numpy(cars["speed"].copy())[on_road]
        torch.testing.assert_close(ego.speed[on_road].double(), speed, atol=2e-3, rtol=0)
        compared += int(on_road.sum())
        # Every lane in turn to the left, FASTER and SLOWER in random order; LANE_LEFT stays on the road.
        action = torch.tensor([0, 1, 3, 4])[torch.randint(0, 4, (len(SEEDS),), generator=generator)]
        td = env.step(td.set("action", action))["next"]
        state = moves.after(ego, action)
    assert compared > 200


def test_a_lane_that_does_not_exist_is_noticed() -> None:
    env = roads(WORLD, lanes=3)
    moves, assumed = reckoning(FACTS, "discrete"), Assumed(FACTS.features, "relative", 0.1)
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    state = moves.unknown(torch.tensor(SEEDS))
    found = torch.zeros(len(SEEDS), dtype=torch.bool)
    for _ in range(75):
        ego = moves.now(assumed.boxes(td["observation"]), state)
        action = torch.full((len(SEEDS),), 2)
        td = env.step(td.set("action", action))["next"]
        state = moves.after(ego, action)
        found |= ~td["done"].squeeze(-1) & (ego.edge == 2)
    assert bool(found.any())
