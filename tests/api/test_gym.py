"""Driving worlds as gymnasium environments, and the CartPole world of the documentation."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import cavbench
from bench.conformance import complaints
from bench.plugins import registry
from bench.scenarios import SeedBlock
from tests.framework.conftest import Said
from tests.framework.distributions import install

Bench = Callable[..., Said]
PAGE = Path(__file__).parents[2] / "docs" / "gymnasium.md"
CELL: dict[str, Any] = {"lanes": 3, "density": 1, "weather": "clear"}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
def test_the_highway_passes_gymnasiums_checks(action_type: Any) -> None:
    env = cavbench.gym.make("highway", action_type=action_type, max_steps=20, **CELL)
    check_env(env, skip_render_check=True)
    env.close()


def test_registered_environments_take_axes_and_parameters() -> None:
    env = gymnasium.make("cavbench/highway-v0", lanes=[3, 4], density=1, weather="clear", vehicles=5)
    seen = [env.reset(seed=seed)[1] for seed in range(12)]
    assert {info["cell"]["lanes"] for info in seen} == {3, 4}
    assert all(info["scenario"] >= SeedBlock.TRAIN for info in seen)
    assert env.reset(seed=3)[1]["scenario"] == seen[3]["scenario"]
    assert env.unwrapped.world.vehicles == 5  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("options", "line"),
    [({"lanes": 99}, "lanes must be a whole number between 2 and 8"), ({"world": "highwy"}, "did you mean 'highway'")],
)
def test_what_is_not_allowed_is_one_line(options: dict[str, Any], line: str) -> None:
    with pytest.raises(cavbench.UserError, match=line):
        cavbench.gym.make(**options)


def test_a_vector_environment_drives_like_single_ones() -> None:
    envs = cavbench.gym.make_vec("highway", num_envs=3, max_steps=6, **CELL)
    alone = cavbench.gym.make("highway", max_steps=6, **CELL)
    observation, _ = envs.reset(seed=5)
    assert observation in envs.observation_space
    starts = 0
    for _ in range(14):
        observation, _, terminated, truncated, info = envs.step(np.array([1, 3, 4]))
        assert not (terminated & truncated).any()
        ended = terminated | truncated
        starts += int(ended.sum())
    assert starts == 6, "every episode ends twice in 14 steps: 6 decisions and a reset each"
    assert set(info) >= {"progress", "speed", "_speed"}
    alone.reset(seed=5)
    rewards = [alone.step(3)[1] for _ in range(6)]
    assert 0 < min(rewards) <= max(rewards) <= 1
    envs.close()


def test_a_model_trained_in_it_is_scored(tmp_path: Path) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    env = cavbench.gym.make("highway", max_steps=40, **CELL)
    model = sb3.DQN("MlpPolicy", env, learning_starts=50, seed=0, device="cpu")
    before = model.policy.q_net.q_net[0].weight.clone()
    model.learn(300)
    assert not torch.equal(before, model.policy.q_net.q_net[0].weight)
    world = cavbench.component("world", "highway", max_steps=40)
    found = cavbench.score(model, "noise", world=world, **CELL, episodes=2, baselines=False, out=tmp_path)
    assert list(found.role) == ["attacked", "clean"]


def test_an_actor_critic_is_scored_after_its_training(tmp_path: Path) -> None:
    """Its policy keeps the distribution of the last update, with a graph that torch does not copy."""
    sb3 = pytest.importorskip("stable_baselines3")
    env = cavbench.gym.make("highway", max_steps=20, **CELL)
    model = sb3.PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=0, device="cpu").learn(32)
    assert model.policy.action_dist.distribution.logits.requires_grad
    world = cavbench.component("world", "highway", max_steps=20)
    found = cavbench.score(
        model, cavbench.component("attack", "pgd", steps=2, restarts=1), world=world, **CELL, episodes=2, baselines=False,
        workers=2, out=tmp_path,
    )  # fmt: skip
    assert list(found.role) == ["attacked", "clean"]
    assert model.policy.action_dist.distribution is not None, "the model itself is as it was"


@pytest.fixture
def cartpole(plugins: Path) -> Iterator[Any]:
    """The module of the page, installed as a package."""
    code = next(
        block for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL) if "GymWorld)" in block
    )
    points = {
        "cavbench.worlds": {"cartpole": "cartpole:CartPole"},
        "cavbench.grids": {"cartpole-v1": "cartpole:CARTPOLE_V1"},
    }
    install(plugins, "cartpole", points, {"cartpole": code})
    registry.installed.cache_clear()
    import cartpole  # type: ignore[import-not-found]

    yield cartpole
    del sys.modules["cartpole"]


def balancing() -> torch.nn.Module:
    """A linear policy that keeps the pole up, on the environment's own observation."""
    linear = torch.nn.Linear(4, 2, bias=False)
    with torch.no_grad():
        linear.weight[0] = torch.tensor([-0.1, -0.2, -3.0, -0.6])
        linear.weight[1] = -linear.weight[0]
    return linear


def test_cartpole_is_scored_under_noise_and_pgd(cartpole: Any, tmp_path: Path) -> None:
    found = cavbench.score(
        balancing(), ["noise", cavbench.component("attack", "pgd", objective="margin")], pole=0.5, episodes=3,
        world=cartpole.CartPole(max_steps=150), actions="discrete", out=tmp_path,
        threat={"norm": "linf", "budget": 0.2},
    )  # fmt: skip
    by_role = found.set_index("attack").safe_progress
    clean = found[found.role == "clean"].iloc[0]
    assert (clean.safe_progress, clean.crashed) == (1.0, 0.0)
    assert by_role["pgd(objective=margin)"] < 1.0
    assert {"blind(policy=left)", "blind(policy=right)", "random"} <= set(found.victim)
    rows = found.records[found.records.attack == "pgd"]
    assert 0 < rows.linf_m.max() <= 0.2 * 4.8 + 1e-6
    assert (rows.excess_max < 1e-5).all()


def test_the_world_passes_the_checks_of_plug_ins(cartpole: Any) -> None:
    assert complaints("world", "cartpole") == []


def test_the_command_scores_a_file_in_it(cartpole: Any, bench: Bench, tmp_path: Path) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    env = cartpole.CartPole().environment(cartpole.CARTPOLE_V1.cells()[0])
    sb3.PPO("MlpPolicy", env, seed=0, device="cpu").save(tmp_path / "model.zip")
    words = (
        f"attack=pgd attack.objective=margin world=cartpole victim=sb3 victim.path={tmp_path}/model.zip "
        "victim.trained_in=cartpole(max_steps=50)"
    )
    said = bench(
        "run",
        *words.split(),
        "pole=0.5",
        "episodes=2",
        "world.max_steps=50",
        "executor=serial",
        f"out={tmp_path / 'results'}",
    )
    assert said.code == 0, said.err
    assert "pgd" in said.out


def square(env: Any) -> Any:
    box = gymnasium.spaces.Box(-np.inf, np.inf, (2, 2), np.float32)
    return gymnasium.wrappers.TransformObservation(env, lambda observation: observation.reshape(2, 2), box)


class Bounded(gymnasium.ObservationWrapper):  # type: ignore[type-arg]
    """All entries on [-1, 1]: what a policy in other units was trained on."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Box(-1, 1, (4,), np.float32)

    def observation(self, observation: Any) -> Any:
        return np.tanh(observation)


@pytest.mark.parametrize(
    ("wrap", "line"),
    [
        (square, r"was trained on Box\(-inf, inf, \(2, 2\)\), this world shows an array of shape \(4,\)"),
        (Bounded, r"was trained on Box\(-1, 1, \(4,\)\), this world shows .* with x from -4.8 to 4.8"),
    ],
)
def test_a_model_of_other_observations_is_refused_alike_from_python_from_a_file_and_by_the_command(
    cartpole: Any, bench: Bench, tmp_path: Path, wrap: Any, line: str
) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    world = cartpole.CartPole(max_steps=20)
    model = sb3.DQN("MlpPolicy", wrap(world.environment(cartpole.CARTPOLE_V1.cells()[0])), buffer_size=10, seed=0)
    model.save(tmp_path / "model.zip")
    for victim in (model, cavbench.component("victim", "sb3", path=str(tmp_path / "model.zip"))):
        with pytest.raises(cavbench.UserError, match=line) as error:
            cavbench.score(victim, "none", world=world, pole=0.5, episodes=1, baselines=False, out=tmp_path)
        assert "\n" not in str(error.value)
        assert "defense" not in str(error.value)
    words = (
        f"attack=none world=cartpole victim=sb3 victim.path={tmp_path}/model.zip pole=0.5 episodes=1 executor=serial"
    )
    said = bench("run", *words.split(), f"out={tmp_path / 'results'}")
    assert said.code != 0
    assert re.search(line, " ".join(said.err.split()))
    assert "defense" not in said.err
    assert "Traceback" not in said.err


def test_the_environment_of_a_model_says_whether_it_was_trained_in_the_world(cartpole: Any, tmp_path: Path) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    world = cartpole.CartPole(max_steps=20)

    def scored(env: Any) -> str:
        model = sb3.DQN("MlpPolicy", env, buffer_size=10, seed=0)
        found = cavbench.score(
            model, "none", world=world, pole=0.5, episodes=1, baselines=False, out=tmp_path, actions=None
        )
        return str(json.loads(found.records.victim_params[0])["trained_in"])

    own = world.environment(cartpole.CARTPOLE_V1.cells()[0])
    assert scored(own) == "cartpole(max_steps=20)"
    assert scored(gymnasium.make("CartPole-v0")) == "CartPole-v0"
    with pytest.raises(cavbench.UserError, match="was trained behind NormalizeObservation, which the world does not"):
        scored(gymnasium.wrappers.NormalizeObservation(own))
    # cavbench.gym.make gives one row on [-1, 1], which such a policy is given, too.
    assert scored(cavbench.gym.make(world, pole=0.5)) == "cartpole(max_steps=20)"


def test_an_environment_that_is_not_as_declared_is_refused(cartpole: Any) -> None:
    class Other(cartpole.CartPole):  # type: ignore[misc]
        def environment(self, cell: Any) -> Any:
            return gymnasium.make("MountainCar-v0")

    with pytest.raises(cavbench.UserError, match="declares 4 features, its environment observes Box"):
        Other().make(cartpole.CARTPOLE_V1.cells())
