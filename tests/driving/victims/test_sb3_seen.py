"""Files and objects behind VecNormalize and stacks of frames decide like the model behind its own wrappers."""

from __future__ import annotations

import contextlib
import io
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import cavbench
from cavbench.core.pair import choose
from cavbench.driving.victims.in_process import in_process
from cavbench.driving.victims.sb3_seen import statistics
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from cavbench.formats import pickled

sb3 = pytest.importorskip("stable_baselines3")
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize  # noqa: E402

FACTS = HighwayWorld().facts
STEPS = 16


def single() -> gymnasium.Env[Any, Any]:
    return cavbench.gym.make("highway", lanes=3, density=1, weather="clear", max_steps=STEPS)


def continuous() -> gymnasium.Env[Any, Any]:
    return cavbench.gym.make("highway", lanes=3, density=1, weather="clear", max_steps=STEPS, action_type="continuous")


def gymnasium_stack(padding: str) -> Any:
    return DummyVecEnv([lambda: gymnasium.wrappers.FrameStackObservation(single(), 3, padding_type=padding)])


ENVIRONMENTS: dict[str, tuple[Callable[[], Any], dict[str, Any]]] = {
    "VecNormalize": (lambda: VecNormalize(DummyVecEnv([single])), {}),
    "VecFrameStack": (lambda: VecFrameStack(DummyVecEnv([single]), 3), {"frames": 3}),
    "VecFrameStack, channels first": (
        lambda: VecFrameStack(DummyVecEnv([single]), 3, channels_order="first"),
        {"frames": 3},
    ),
    "VecFrameStack of VecNormalize": (lambda: VecFrameStack(VecNormalize(DummyVecEnv([single])), 3), {"frames": 3}),
    "VecNormalize of VecFrameStack": (lambda: VecNormalize(VecFrameStack(DummyVecEnv([single]), 3)), {"frames": 3}),
    "FrameStackObservation": (lambda: gymnasium_stack("reset"), {"frames": 3}),
    "FrameStackObservation, zeros": (lambda: gymnasium_stack("zero"), {"frames": 3, "padding": "zero"}),
    "FlattenObservation": (
        lambda: VecFrameStack(DummyVecEnv([lambda: gymnasium.wrappers.FlattenObservation(single())]), 3),
        {"frames": 3},
    ),
}


def normaliser(env: Any) -> Any:
    while env is not None and type(env).__name__ != "VecNormalize":
        env = getattr(env, "venv", None)
    return env


def model_of(env: Any, algorithm: str = "dqn") -> Any:
    """A model with large random weights, so that its decisions vary, after a few steps of training."""
    options = {"learning_starts": 5, "buffer_size": 50} if algorithm != "ppo" else {"n_steps": 8, "batch_size": 8}
    model = getattr(sb3, algorithm.upper())("MlpPolicy", env, seed=0, device="cpu", **options).learn(16)
    with torch.no_grad():
        for weight in model.policy.parameters():
            weight.add_(0.5 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(weight.numel())))
    return model


@torch.no_grad()
def recorded(model: Any, env: Any) -> tuple[torch.Tensor, torch.Tensor, list[int]]:
    """An episode of random actions: what the world shows [T, 10, 5], and what the model would do behind its wrappers.

    Its values or logits [T, 5], and the actions of its `predict`.
    """
    statistics = normaliser(env)
    if statistics is not None:
        statistics.training = False
    seen, values, actions = [], [], []
    shown, done = env.reset(), False
    while not done:
        seen.append(env.unwrapped.envs[0].unwrapped._td["observation"][0].clone())
        given = torch.as_tensor(shown).float()
        network = getattr(model.policy, "q_net", None)
        values.append(network(given) if network else model.policy.get_distribution(given).distribution.logits)
        actions.append(int(model.predict(shown, deterministic=True)[0][0]))
        shown, _, dones, _ = env.step([len(actions) * 7 % 5])
        done = bool(dones[0])
    return torch.stack(seen), torch.cat(values), actions


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_model_behind_wrappers_decides_as_behind_its_own(name: str, tmp_path: Path) -> None:
    make, options = ENVIRONMENTS[name]
    env = make()
    # The buffer of DQN takes no frames that are normalised before they are stacked.
    model = model_of(env, "ppo" if name == "VecFrameStack of VecNormalize" else "dqn")
    seen, values, actions = recorded(model, env)
    assert values.std(0).min() > 1e-3
    model.save(tmp_path / "model.zip")
    if (statistics := normaliser(env)) is not None:
        statistics.save(tmp_path / "statistics.pkl")
        options = {**options, "normalize": str(tmp_path / "statistics.pkl")}
    victims = [choose("victim", "sb3", path=str(tmp_path / "model.zip"), **options).component]
    victims.append(in_process([model], FACTS, seen[:1].expand(4, -1, -1), None))
    for victim in victims:
        policy = victim.load(0, FACTS)
        state = policy.initial(torch.arange(1))
        for shown, wanted, action in zip(seen, values, actions, strict=True):
            scores = policy.scores(shown[None], state)
            # The logits of an object are normalised, those of a file are not.
            torch.testing.assert_close(scores[0] - scores.amax(), wanted - wanted.amax(), rtol=1e-5, atol=1e-4)
            assert int(policy.choose(scores)) == action
            state = policy.advance(shown[None], policy.choose(scores), state)


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_statistics_beside_a_file_are_those_of_its_policy_and_of_its_critic(algorithm: str, tmp_path: Path) -> None:
    env = VecNormalize(DummyVecEnv([continuous]))
    model = model_of(env, algorithm)
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "statistics.pkl"))
    path = {"path": str(tmp_path / "model.zip"), "normalize": str(tmp_path / "statistics.pkl")}
    policy = choose("victim", "sb3", **path).component.load(0, FACTS)
    observation = torch.rand(50, 10, 5) * 2 - 1
    shown = env.normalize_obs(observation.numpy())
    wanted, _ = model.predict(shown, deterministic=True)
    torch.testing.assert_close(policy.decide(observation), torch.from_numpy(wanted), rtol=0, atol=2e-6)
    if algorithm == "sac":
        action = torch.rand(50, 2)
        with torch.no_grad():
            value = model.policy.critic(torch.from_numpy(shown).float(), action)[0].squeeze(-1)
        torch.testing.assert_close(policy.value(observation, action), value)


def test_an_object_brings_its_own_features_extractor_and_a_file_does_not(tmp_path: Path) -> None:
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    class Layers(BaseFeaturesExtractor):  # type: ignore[misc]
        def __init__(self, space: Any) -> None:
            super().__init__(space, 12)
            self.net = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(50, 12), torch.nn.ReLU())

        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            return self.net(observation)

    model = sb3.PPO("MlpPolicy", single(), n_steps=8, seed=0, policy_kwargs={"features_extractor_class": Layers})
    observation = torch.rand(50, 10, 5) * 2 - 1
    wanted, _ = model.predict(observation.numpy(), deterministic=True)
    found = in_process([model], FACTS, observation, None).load(0, FACTS).decide(observation)
    assert found.tolist() == wanted.tolist()
    model.save(tmp_path / "model.zip")
    with pytest.raises(UserError, match=r"whose code is not in it: give cavbench.score the model itself"):
        choose("victim", "sb3", path=str(tmp_path / "model.zip")).component.load(0, FACTS)


def test_statistics_of_a_training_that_normalised_rewards_only_change_nothing(tmp_path: Path) -> None:
    env = VecNormalize(DummyVecEnv([single]), norm_obs=False)
    env.save(str(tmp_path / "statistics.pkl"))
    assert statistics(str(tmp_path / "statistics.pkl")) is None


class Harm:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def test_a_file_of_statistics_is_never_unpickled(tmp_path: Path) -> None:
    env = VecNormalize(DummyVecEnv([single]))
    env.harm = Harm(tmp_path / "harm")
    content = io.BytesIO()
    pickle.dump(env, content)
    (tmp_path / "statistics.pkl").write_bytes(content.getvalue())
    assert statistics(str(tmp_path / "statistics.pkl")) is not None
    assert not (tmp_path / "harm").exists()
    (tmp_path / "harm.pkl").write_bytes(pickle.dumps(Harm(tmp_path / "harm")))
    with pytest.raises(UserError, match=r"it is not a file of Stable-Baselines3's VecNormalize.save"):
        statistics(str(tmp_path / "harm.pkl"))
    assert not (tmp_path / "harm").exists()
    pickle.loads((tmp_path / "harm.pkl").read_bytes())
    assert (tmp_path / "harm").exists(), "the file would do harm if it were unpickled"


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_damaged_file_is_one_error(data: st.DataObject) -> None:
    content = bytearray(pickle.dumps({"a": np.arange(6.0).reshape(2, 3), "b": [1, (2, "x"), {3}]}))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    # Whatever it reads, it is data; all that it raises is a ValueError.
    with contextlib.suppress(ValueError):
        pickled.array(pickled.read(bytes(content)))


def test_an_array_is_read_in_every_protocol() -> None:
    for protocol in range(2, 6):
        for array in (np.arange(6.0).reshape(2, 3), np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3))):
            found = pickled.array(pickled.read(pickle.dumps(array, protocol)))
            assert found is not None or protocol == 2
            if found is not None:
                np.testing.assert_array_equal(found, array)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (
            {"frames": 4},
            r"was trained on Box\(-1, 1, \(10, 15\)\), which is no stack of victim.frames=4 observations \(10, 5\)",
        ),
        ({"padding": "zero"}, "victim.padding is for a policy with a stack of frames"),
        ({"frames": 3, "normalize": "none.pkl"}, "there is no file none.pkl; set victim.normalize"),
    ],
)
def test_what_does_not_fit_is_one_line(options: dict[str, Any], line: str, tmp_path: Path) -> None:
    model_of(VecFrameStack(DummyVecEnv([single]), 3)).save(tmp_path / "model.zip")
    with pytest.raises(UserError, match=line) as error:
        choose("victim", "sb3", path=str(tmp_path / "model.zip"), **options).component.load(0, FACTS)
    assert "\n" not in str(error.value)
