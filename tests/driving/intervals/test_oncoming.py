"""Cars that come towards the ego: their tracks, and the room that they leave."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from cavbench.defenses.driving.shield import Shield, Shielded
from cavbench.defenses.driving.tracker import Tracked, Tracker
from cavbench.driving import Control, ObservationThreat
from cavbench.driving.intervals.ego import Ego
from cavbench.driving.intervals.margins import Judge
from cavbench.driving.intervals.policy import reckoning
from cavbench.driving.intervals.rooms import Cars, Caution
from cavbench.driving.rollout import rollout
from cavbench.driving.victims.planner import IntervalPlanner, Planner
from cavbench.envs.roads.two_way_world import TwoWayWorld
from tests.driving.intervals.drivers import SEEDS, Fastest

WORLD = TwoWayWorld()
FACTS = WORLD.facts_at(WORLD.home)


def test_tracks_hold_the_truth_of_cars_in_both_directions() -> None:
    env = WORLD.build([WORLD.home] * len(SEEDS), Control())
    policy = Tracked(Tracker(), IntervalPlanner(Planner(), FACTS), FACTS)
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    state = policy.initial(torch.tensor(SEEDS))
    generator = torch.Generator().manual_seed(0)
    held, rows, coming = 0, 0, 0
    for _ in range(90):
        truth = td["observation"]
        radius = ObservationThreat().radius(truth, FACTS.features)
        shown = (truth + radius * (2 * torch.rand(truth.shape, generator=generator) - 1)).clamp(-1, 1)
        boxes = policy.boxes(shown, state)
        physical = FACTS.features.physical(truth)
        # Where the range of the sensor ends, only the track knows more.
        ends = truth[..., 1:].abs() >= 1
        inside = (((boxes.low - 1e-2 <= physical) & (physical <= boxes.high + 1e-2)) | ends).all(-1)[:, 1:]
        present = (boxes.present & ~td["done"])[:, 1:]
        held, rows = held + int((inside & present).sum()), rows + int(present.sum())
        against = physical[:, 1:, 2] + physical[:, :1, 2] < -5
        coming += int((present & against).sum())
        action = policy.decide(shown, state)
        state = policy.advance(shown, action, state)
        td = env.step(td.set("action", action))["next"]
    assert held == rows
    assert coming > 50


def test_a_lane_counts_as_free_of_a_car_only_until_that_car_is_there() -> None:
    """The faster it comes, the less room."""
    one, found = torch.ones(1), []
    caution = Caution(braking=0.5, seconds=2.0, distance=0.4)
    judge = Judge(reckoning(FACTS, "discrete"), 1 / FACTS.decision_hz, caution)
    for speed in (-1.0, -10.0, -20.0):
        ego = Ego(y=4 * one, heading=0 * one, speed=20 * one, target_lane=one, target_speed=20 * one, edge=one)
        bounds = torch.tensor([[[60.0, 0.0, speed, 0.0]]]).requires_grad_()
        cars = Cars(torch.ones(1, 1, dtype=torch.bool), bounds, bounds)
        front, _ = judge.rooms(ego, cars, *judge._options(ego))
        # The last table counts 0.2 s, and the decision before it.
        room = front[0, -1, 0, 0]
        found.append(float(room))
        (slope,) = torch.autograd.grad(room, bounds)
        assert abs(float(slope[0, 0, 2]) - (0.2 + 1 / 15)) < 1e-3
    assert abs((found[0] - found[2]) / 19 - (0.2 + 1 / 15)) < 1e-3


def test_who_always_accelerates_does_not_crash_behind_the_filter() -> None:
    env = WORLD.build([WORLD.home] * len(SEEDS), Control())
    policy = Shielded(Shield(assumed_budget=0.0), Fastest(), FACTS)
    found = rollout(env, policy, None, ObservationThreat(), list(SEEDS), facts=FACTS, attack_seed=0)
    assert not any(found["crashed"])
