"""Environments whose observations are attacked, to train in."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict

import cavbench
from cavbench.driving import Policy
from tests.isolation.torch_modes import CALLERS

CELL: dict[str, Any] = {"lanes": 3, "density": 1, "weather": "clear"}


def pgd(**parameters: Any) -> Any:
    return cavbench.component("attack", "pgd", steps=2, restarts=1, **parameters)


def test_the_learner_sees_what_the_attack_shows_and_earns_what_it_earns() -> None:
    plain = cavbench.gym.make("highway", max_steps=8, **CELL)
    env = cavbench.gym.AttackedEnv(cavbench.gym.make("highway", max_steps=8, **CELL), pgd(), "dqn")
    seen, info = env.reset(seed=4)
    true, _ = plain.reset(seed=4)
    changed = 0
    for step in range(8):
        assert (info["truth"] == true).all()
        assert 0 < np.abs(seen - true).max() <= 0.1 + 1e-6 or not info["attack"]["size"]
        assert seen in env.observation_space
        assert info["attack"]["queries"] > info["attack"]["gradients"] > 0
        changed += info["attack"]["changed"]
        seen, reward, terminated, truncated, info = env.step(step % 5)
        true, wanted, *ends, _ = plain.step(step % 5)
        assert (reward, terminated, truncated) == (wanted, *ends)
    assert changed
    assert truncated


def test_the_same_seed_shows_the_same_attack() -> None:
    env = cavbench.gym.AttackedEnv(cavbench.gym.make("highway", max_steps=8, **CELL), "noise", "dqn")
    first, second, again = (env.reset(seed=seed)[0] for seed in (7, None, 7))
    assert (first == again).all()
    assert (first != second).any()


def test_the_policy_is_attacked_as_it_is_when_the_episode_begins() -> None:
    network = torch.nn.Linear(4, 2)
    env = cavbench.gym.AttackedEnv(gymnasium.make("CartPole-v1"), pgd(objective="margin", random_start=False), network)
    for sensor in (0, 2):
        with torch.no_grad():
            network.weight.zero_()
            network.weight[0, sensor] = 1.0
        seen, info = env.reset(seed=1)
        assert np.flatnonzero(seen != info["truth"]).tolist() == [sensor], "the policy looks at nothing else"


def test_nothing_is_attacked_until_a_model_is_there() -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    env = cavbench.gym.AttackedEnv(gymnasium.make("CartPole-v1"), pgd(objective="margin"))
    assert "attack" not in env.reset(seed=1)[1]
    env.policy = model = sb3.DQN("MlpPolicy", env, learning_starts=10, seed=0, device="cpu")
    assert env.reset(seed=1)[1]["attack"]["queries"] > 0
    model.learn(40)


class Remembers(Policy):
    """Its scores depend on what it was shown before."""

    action_type: ClassVar[Any] = "discrete"

    def initial(self, episodes: torch.Tensor) -> Any:
        return TensorDict({"sum": torch.zeros(len(episodes))}, batch_size=episodes.shape)

    def scores(self, observation: torch.Tensor, state: Any = None) -> torch.Tensor:
        return torch.stack([state["sum"] + observation[..., 0, 1], state["sum"] * 0], -1)

    def advance(self, observation: torch.Tensor, action: torch.Tensor, state: Any) -> Any:
        return state.clone().set("sum", state["sum"] + observation[..., 0, 1] + action)


def test_a_policy_with_a_memory_is_told_what_was_shown_and_done() -> None:
    env = cavbench.gym.AttackedEnv(gymnasium.make("CartPole-v1"), "noise", Remembers().eval())
    env.reset(seed=1)
    for action in (1, 0, 1):
        env.step(action)
    assert env._session is not None
    assert env._session.state is not None
    assert 1.5 < float(env._session.state["sum"]) < 2.5


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"threat": {"budget": 9}}, "threat: threat.budget must be between 0 and 2"),
        ({"attack": "plan"}, "does not fit world .*: it needs the dynamics"),
        ({"policy": torch.nn.Linear(3, 2)}, "must map observations"),
    ],
)
def test_what_is_wrong_is_one_line(options: dict[str, Any], line: str) -> None:
    given: dict[str, Any] = {"attack": "noise", "policy": torch.nn.Linear(4, 2)} | options
    with pytest.raises(cavbench.UserError, match=line):
        cavbench.gym.AttackedEnv(gymnasium.make("CartPole-v1"), **given).reset(seed=0)


@pytest.mark.parametrize(
    ("mode", "name", "allowed"),
    [
        ("lost", "actuator", {"replaced": 0.5}),
        ("rude", "dynamics", {"time_gap": 0.6, "braking": 7.0, "lane_gain": 0.0, "imposed_braking": 5.0}),
    ],
)
def test_a_set_that_changes_what_cars_do_is_refused(mode: Any, name: str, allowed: dict[str, float]) -> None:
    """Nothing would be attacked: the environment drives on as it is."""
    fault, line = cavbench.component("attack", "fault", mode=mode), f"threat.{name} changes what cars do"
    env = cavbench.gym.make("highway", **CELL)
    seen, _ = env.reset(seed=0)
    with pytest.raises(cavbench.UserError, match=line):
        cavbench.gym.AttackedEnv(env, fault, "dqn", threat={name: allowed}).reset(seed=0)
    with pytest.raises(cavbench.UserError, match=line):
        cavbench.attack(fault, "dqn", seen, threat={name: allowed}, **CELL)


@pytest.mark.parametrize("mode", CALLERS)
def test_a_training_in_a_mode_of_torch_is_attacked_as_without(mode: str) -> None:
    """Libraries collect episodes in inference mode, in which an attack had no gradient."""

    def shown() -> list[Any]:
        env = cavbench.gym.AttackedEnv(cavbench.gym.make("highway", max_steps=4, **CELL), pgd(), "dqn")
        return [env.reset(seed=4), *(env.step(1) for _ in range(3))]

    wanted = shown()
    with CALLERS[mode]():
        found = shown()
    for (seen, *_, info), (other, *_, about) in zip(wanted, found, strict=True):
        assert info["attack"]["gradients"] == about["attack"]["gradients"] > 0
        assert (seen == other).all()
