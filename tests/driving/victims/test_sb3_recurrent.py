"""A RecurrentPPO of sb3-contrib is rebuilt from its file without sb3-contrib, and decides like its own predict."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from cavbench.core.pair import choose
from cavbench.driving import Policy
from cavbench.driving.trial import try_policy
from cavbench.driving.victims.in_process import in_process
from cavbench.envs.highway.world import HighwayWorld
from tests.driving.victims.policy_files import FACTS
from tests.driving.victims.recurrent_model import EPISODES, HERE, STEPS

SHOWN = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (STEPS, EPISODES, 10, 5)).astype(np.float32))
ACTIONS = json.loads((HERE / "recurrent_ppo.json").read_text())["actions"]
"""Of the model's own `predict`, with its state (`recurrent_model.py`)."""


def decides_alike(policy: Policy) -> None:
    state, found, fresh = policy.initial(torch.arange(EPISODES)), [], []
    for shown in SHOWN:
        fresh.append(policy.decide(shown, policy.initial(torch.arange(EPISODES))).tolist())
        action = policy.decide(shown, state)
        found.append(action.tolist())
        state = policy.advance(shown, action, state)
    assert found == ACTIONS
    assert fresh != ACTIONS, "the memory would not matter"


def test_a_file_decides_like_predict() -> None:
    policy = choose("victim", "sb3", path=str(HERE / "recurrent_ppo.zip")).component.load(0, FACTS)
    decides_alike(policy)
    world = HighwayWorld(max_steps=40)
    cells = [world.axes.cell(lanes=3, density=1.0, weather="clear")]
    assert try_policy(policy, world, cells, gradients=True, random=False) == []


def test_an_object_decides_like_predict(tmp_path: Path) -> None:
    contrib: Any = pytest.importorskip("sb3_contrib", reason="pip install sb3-contrib==2.9.2")
    model = contrib.RecurrentPPO.load(HERE / "recurrent_ppo.zip")
    decides_alike(in_process([model], FACTS, SHOWN[0], None).load(0, FACTS))
