"""The tracker narrows what the boxes of one observation leave open."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from cavbench.defenses.driving.tracker import Tracked, Tracker
from cavbench.driving import ObservationThreat
from cavbench.driving.victims.planner import IntervalPlanner, Planner
from cavbench.errors import UserError
from tests.driving.intervals.drivers import FACTS, SEEDS, WORLD, roads
from tests.plugins.toy import ToyWorld


def test_the_tracker_narrows_boxes_and_keeps_the_truth() -> None:
    env = roads(WORLD, lanes=4)
    policy = Tracked(Tracker(), IntervalPlanner(Planner(), FACTS), FACTS)
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    state = policy.initial(torch.tensor(SEEDS))
    generator, half = torch.Generator().manual_seed(0), FACTS.features.half_range()
    held = narrower = rows = 0
    for _ in range(60):
        truth = td["observation"]
        radius = ObservationThreat().radius(truth, FACTS.features)
        shown = (truth + radius * (2 * torch.rand(truth.shape, generator=generator) - 1)).clamp(-1, 1)
        plain, boxes = policy.assumed.boxes(shown), policy.boxes(shown, state)
        physical = (truth[..., 1:] * half)[:, 1:]
        inside = ((boxes.low[:, 1:] - 1e-2 <= physical) & (physical <= boxes.high[:, 1:] + 1e-2)).all(-1)
        present = boxes.present[:, 1:] & ~td["done"]
        present &= plain.high[:, 1:, 0].isfinite()
        held, rows = held + int((inside & present).sum()), rows + int(present.sum())
        width, before = boxes.high[:, 1:, 0] - boxes.low[:, 1:, 0], plain.high[:, 1:, 0] - plain.low[:, 1:, 0]
        narrower += int(((width < before - 0.01) & present).sum())
        action = policy.decide(shown, state)
        state = policy.advance(shown, action, state)
        td = env.step(td.set("action", action))["next"]
    assert held == rows
    assert narrower / rows > 0.5


def test_a_world_without_kinematics_is_refused_in_one_line() -> None:
    with pytest.raises(UserError, match="kinematics") as refused:
        Tracker().load(Planner(), 0, ToyWorld().facts)
    assert "\n" not in str(refused.value)
