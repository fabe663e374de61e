"""Policies of highway-env's own tasks with another configuration: refused in them, with what to type, which works."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gymnasium
import pytest

import cavbench
from cavbench.driving.victims.sb3 import StableBaselines3
from cavbench.envs.highway.tasks import HighwayFastV0
from cavbench.errors import UserError

sb3 = pytest.importorskip("stable_baselines3")
pytest.importorskip("highway_env")

FEATURES = ["presence", "x", "y", "vx", "vy", "cos_h", "sin_h"]
OTHER = {
    "more features": ({"observation": {"type": "Kinematics", "features": FEATURES}}, r"Box\(-inf, inf, \(5, 7\)\)"),
    "another order": (
        {"observation": {"type": "Kinematics", "features": ["x", "y", "vx", "vy", "presence"]}},
        "none of this world: the presence of a car, the first feature of its row",
    ),
    "metres": ({"observation": {"type": "Kinematics", "normalize": False}}, r"beyond \[-1, 1\]"),
    "absolute": ({"observation": {"type": "Kinematics", "absolute": True}}, r"m ahead \(absolute: true"),
    "a grid": ({"observation": {"type": "OccupancyGrid"}}, r"\(4, 11, 11\)"),
    "one control": ({"action": {"type": "ContinuousAction", "lateral": False}}, "1 continuous actions"),
}


def model_in(config: dict[str, Any], path: Path, algorithm: str = "PPO") -> Path:
    """A model that was trained for a moment in highway-fast-v0 with this configuration; its last observation is 10 s old."""
    import highway_env

    gymnasium.register_envs(highway_env)
    env = gymnasium.make("highway-fast-v0", config={"vehicles_count": 3, **config})
    small = {"n_steps": 10} if algorithm == "PPO" else {"learning_starts": 5, "buffer_size": 100}
    model = getattr(sb3, algorithm)("MlpPolicy", env, seed=3, device="cpu", **small)
    model.learn(10).save(path)
    return path


@pytest.mark.parametrize("what", OTHER)
def test_another_configuration_is_refused_with_what_to_type(what: str, tmp_path: Path) -> None:
    config, words = OTHER[what]
    path = model_in(config, tmp_path / "model.zip")
    with pytest.raises(UserError, match=words) as refused:
        StableBaselines3(path=str(path)).load(0, HighwayFastV0().facts)
    assert re.search(
        r"world=gym world\.id=highway-fast-v0 'world\.config=\{(observation|action): \{", str(refused.value)
    )


@pytest.mark.parametrize("algorithm", ["PPO", "DQN"])
def test_its_own_configuration_is_not(algorithm: str, tmp_path: Path) -> None:
    StableBaselines3(path=str(model_in({}, tmp_path / "model.zip", algorithm))).load(0, HighwayFastV0().facts)


def test_another_order_is_not_taken_for_normalised_observations(tmp_path: Path) -> None:
    """DQN keeps an observation before the last always: it is as strange as the last, so no statistics are missing."""
    path = model_in(OTHER["another order"][0], tmp_path / "model.zip", "DQN")
    with pytest.raises(UserError, match="none of this world: the presence of a car"):
        StableBaselines3(path=str(path)).load(0, HighwayFastV0().facts)


def test_what_is_to_be_typed_works(tmp_path: Path) -> None:
    path = model_in(OTHER["more features"][0], tmp_path / "model.zip")
    gym = cavbench.component("world", "gym", id="highway-fast-v0", config=OTHER["more features"][0])
    assert StableBaselines3(path=str(path)).load(0, gym.facts)
