"""A file of a policy that does not fit is refused in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from torch import nn

from cavbench.errors import UserError
from tests.driving.victims.policy_files import (
    FACTS,
    Fewer,
    Scores,
    onnx_file,
    saved,
    sb3_file,
    spaces,
    torch_file,
)


def bad_text(path: Path) -> dict[str, str]:
    path.write_text("nothing of the kind")
    return {"path": str(path)}


BAD: dict[str, tuple[str, Callable[[Path], dict[str, str]], str]] = {
    "no file": ("torch", lambda path: {"path": str(path)}, "there is no file"),
    "no program": ("torch", bad_text, "cannot be read"),
    "fixed batch": (
        "torch",
        lambda path: {"path": torch_file(path, fixed=True)},
        "has a fixed batch size of 3: export it",
    ),
    "rows": (
        "torch",
        lambda path: {"path": torch_file(path), "rows": "15"},
        "victim.rows=15 is not this world's observation, which has 10 rows of 5 features",
    ),
    "features": (
        "torch",
        lambda path: {"path": torch_file(path), "features": "7"},
        "victim.features=7 is not this world's observation, which has 10 rows of 5 features",
    ),
    "no world": (
        "torch",
        lambda path: {"path": str(path), "trained_in": "' '"},
        "trained_in must be the world of the training",
    ),
    "another arrangement": (
        "torch",
        lambda path: {"path": torch_file(path, Scores(flat=True), (5, 10))},
        "takes observations (5, 10), this world shows (10, 5), or flattened (50,); these are as many numbers in another",
    ),
    "fewer rows": (
        "torch",
        lambda path: {"path": torch_file(path, Fewer(), (5, 5))},
        "takes observations (5, 5), this world shows (10, 5)",
    ),
    "fewer rows in onnx": (
        "onnx",
        lambda path: {"path": onnx_file(path, Fewer(), (5, 5))},
        "takes observations (5, 5), this world shows (10, 5)",
    ),
    "two scores": (
        "torch",
        lambda path: {"path": torch_file(path, Scores(2))},
        "discrete actions need [1, 5]; if these are acceleration and steering, set victim.actions=continuous",
    ),
    "other actions": (
        "torch",
        lambda path: {"path": torch_file(path), "actions": "continuous"},
        "returns [1, 5] for 1 observation, continuous actions need [1, 2]",
    ),
    "no rows": ("torch", lambda path: {"path": str(path), "rows": "0"}, "rows must be at least 1"),
    "no onnx": ("onnx", bad_text, "cannot be read"),
    "fixed onnx": ("onnx", lambda path: {"path": onnx_file(path, fixed=True)}, "has a fixed batch size of 3"),
    "no zip": ("sb3", lambda path: bad_text(path) | {"algo": "dqn"}, "cannot be read: it is not a zip archive"),
    "unknown algo": ("sb3", lambda path: {"path": str(path), "algo": "dqm"}, "unknown victim.algo 'dqm'"),
    "another algo": (
        "sb3",
        lambda path: {"path": sb3_file(path, "dqn"), "algo": "ppo"},
        "is a model of dqn, victim.algo says ppo; leave victim.algo out",
    ),
    "continuous": (
        "sb3",
        lambda path: {"path": sb3_file(path, "ppo", continuous=True), "actions": "discrete"},
        "has continuous actions, victim.actions says discrete; leave victim.actions out",
    ),
    "other rows": (
        "sb3",
        lambda path: {"path": sb3_file(path, "dqn"), "algo": "dqn", "rows": "5"},
        "victim.rows=5 is not this world's observation",
    ),
    "highway-env's default": (
        "sb3",
        lambda path: saved(path, "dqn", spaces(continuous=False, shape=(5, 5), seen=np.inf)),
        "was trained on Box(-inf, inf, (5, 5)), this world shows Box(-1, 1, (10, 5)). A policy of highway-env's own tasks is "
        "scored in its task: world=highway-fast-v0 or world=highway-v0; of another task, world=gym world.id=TASK, for instance "
        "world.id=merge-v0",
    ),
    "other bounds": (
        "sb3",
        lambda path: saved(path, "ppo", spaces(continuous=False, seen=np.inf)),
        "was trained on Box(-inf, inf, (10, 5)), this world shows Box(-1, 1, (10, 5)). A policy of highway-env's own tasks is "
        "scored in its task: world=highway-fast-v0 or world=highway-v0, with 'world.config={observation: "
        "{vehicles_count: 10}}'",
    ),
    "another of highway-env's tasks": (
        "sb3",
        lambda path: saved(path, "dqn", spaces(continuous=False, shape=(15, 7), seen=np.inf)),
        "A policy of another task is scored in that task: world=gym world.id=TASK, for instance world.id=merge-v0",
    ),
    "two frames": (
        "sb3",
        lambda path: saved(path, "dqn", spaces(continuous=False, shape=(5, 10))),
        'another arrangement. Train it in cavbench.gym.make("highway")',
    ),
    "other range of actions": (
        "sb3",
        lambda path: saved(path, "sac", spaces(continuous=True, high=2.0)),
        'actions in Box(-2, 2, (2,)), not in [-1, 1]. Train it in cavbench.gym.make("highway", action_type="continuous")',
    ),
    "three actions": (
        "sb3",
        lambda path: saved(path, "dqn", with_actions(gymnasium.spaces.Discrete(3))),
        "was trained for 3 discrete actions, this world takes 5 discrete ones (LANE_LEFT, IDLE,",
    ),
    "actions from 1": (
        "sb3",
        lambda path: saved(path, "ppo", with_actions(gymnasium.spaces.Discrete(5, start=1))),
        "numbers its actions from 1; they must be numbered from 0",
    ),
    "many actions": (
        "sb3",
        lambda path: saved(path, "ppo", with_actions(gymnasium.spaces.MultiDiscrete([5, 5]))),
        "was trained for actions of MultiDiscrete; the type must be Discrete or Box",
    ),
    "own extractor": (
        "sb3",
        lambda path: {"path": sb3_file(path, "ppo", features_extractor_class=extractor())},
        "has the features extractor",
    ),
    "own activation": (
        "sb3",
        lambda path: {"path": sb3_file(path, "dqn", activation_fn=Softer), "algo": "dqn"},
        "is not one of torch's",
    ),
}


def with_actions(space: gymnasium.Space[Any]) -> gymnasium.Env[Any, Any]:
    env = spaces(continuous=False)
    env.action_space = space
    return env


def extractor() -> type[nn.Module]:
    """A features extractor that computes what `Flatten` does, in code of its own."""
    layers = pytest.importorskip("stable_baselines3.common.torch_layers")
    return type("Own", (layers.FlattenExtractor,), {})


class Softer(nn.ReLU):
    """An activation of the user's own."""


@pytest.mark.parametrize("what", BAD)
def test_a_file_that_does_not_fit_is_refused_in_one_line(tmp_path: Path, what: str) -> None:
    from cavbench.run.config import component

    name, make, part = BAD[what]
    with pytest.raises(UserError) as raised:
        component("victim", name, make(tmp_path / "file.zip")).load(0, FACTS)
    assert part in str(raised.value)
    assert "\n" not in str(raised.value)
