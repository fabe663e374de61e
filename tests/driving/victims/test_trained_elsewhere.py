"""A policy from outside that was trained in another world is refused, or its record says what is known of its training."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor, nn

import cavbench
from cavbench.core.pair import choose
from cavbench.core.parameters import parameters
from cavbench.driving import DrivingFacts
from cavbench.driving.victims.in_process import in_process
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from cavbench.run import runner
from cavbench.run.config import plan_of
from tests.driving.victims.policy_files import saved, sb3_model, spaces

sb3 = pytest.importorskip("stable_baselines3")
WORLD = HighwayWorld(max_steps=15)
WHERE: dict[str, Any] = {"lanes": 3, "density": 1, "weather": "clear"}
OBSERVATION = cavbench.gym.make(WORLD, **WHERE).reset(seed=0)[0][None].repeat(4, 0)


def make(**options: Any) -> gymnasium.Env[Any, Any]:
    return cavbench.gym.make("highway", **WHERE, **options)


def trained(algorithm: str, env: Any) -> Any:
    """A model after a few steps in an environment."""
    options = {"learning_starts": 5, "buffer_size": 50} if algorithm == "dqn" else {"n_steps": 8, "batch_size": 8}
    return getattr(sb3, algorithm.upper())("MlpPolicy", env, seed=0, device="cpu", **options).learn(16)


def loaded(victim: Any, facts: DrivingFacts = WORLD.facts) -> Any:
    """The policy of a path of a saved model, or of an object."""
    if isinstance(victim, Path):
        return choose("victim", "sb3", path=str(victim)).component.load(0, facts)
    return in_process([victim], facts, torch.from_numpy(OBSERVATION), None).load(0, facts)


def refused(victim: Any, line: str) -> None:
    with pytest.raises(UserError, match=line) as error:
        loaded(victim)
    assert "\n" not in str(error.value)


@pytest.fixture
def score(tmp_path: Path) -> Callable[..., Any]:
    def call(victim: Any, **options: Any) -> Any:
        given = {"world": WORLD, "episodes": 1, "baselines": False, "out": tmp_path / "out", **WHERE, **options}
        return cavbench.score(victim, "none", **given)

    return call


def said(found: Any) -> str:
    """The world of the training in the records."""
    return str(json.loads(found.records["victim_params"].iloc[0])["trained_in"])


@pytest.mark.parametrize("algorithm", ["dqn", "ppo"])
def test_a_model_behind_vec_normalize_is_scored_with_its_statistics_or_not_at_all(
    algorithm: str, tmp_path: Path
) -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    behind = VecNormalize(DummyVecEnv([make]))
    model = trained(algorithm, behind)
    model.save(tmp_path / "model.zip")
    behind.save(str(tmp_path / "statistics.pkl"))
    kind = type(model)
    line = rf"was trained behind VecNormalize.*cavbench.score\({algorithm.upper()}.load\("
    refused(tmp_path / "model.zip", line)
    refused(kind.load(tmp_path / "model.zip"), line)
    restored = VecNormalize.load(str(tmp_path / "statistics.pkl"), DummyVecEnv([make]))
    observation = torch.rand(50, 10, 5) * 2 - 1
    wanted, _ = model.predict(behind.normalize_obs(observation.numpy()), deterministic=True)
    for given in (model, kind.load(tmp_path / "model.zip", env=restored)):
        np.testing.assert_array_equal(loaded(given).decide(observation).numpy(), wanted)


@pytest.mark.parametrize("algorithm", ["dqn", "ppo"])
def test_rewards_may_be_normalised(algorithm: str, tmp_path: Path) -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    model = trained(algorithm, VecNormalize(DummyVecEnv([make] * 2), norm_obs=False))
    model.save(tmp_path / "model.zip")
    observation = torch.rand(50, 10, 5) * 2 - 1
    wanted, _ = model.predict(observation.numpy(), deterministic=True)
    for given in (tmp_path / "model.zip", type(model).load(tmp_path / "model.zip"), model):
        np.testing.assert_array_equal(loaded(given).decide(observation).numpy(), wanted)


class PresenceLast(gymnasium.ObservationWrapper):  # type: ignore[type-arg]
    """The features of a row in another order, in the same space."""

    def observation(self, observation: Any) -> Any:
        return np.roll(observation, -1, axis=-1)


def test_features_in_another_order_are_seen_in_the_last_observation_and_in_the_wrapper(
    tmp_path: Path, score: Callable[..., Any]
) -> None:
    model = trained("ppo", PresenceLast(make()))
    model.save(tmp_path / "model.zip")
    refused(tmp_path / "model.zip", "the last observation of .* in its training is none of this world: ")
    refused(sb3.PPO.load(tmp_path / "model.zip"), "none of this world: ")
    with pytest.raises(UserError, match="was trained behind PresenceLast, which the world does not have"):
        score(sb3.PPO("MlpPolicy", PresenceLast(make()), seed=0))


class Halved(gymnasium.Wrapper):  # type: ignore[type-arg]
    """Changes observations and does not say so by its class."""

    def reset(self, **options: Any) -> Any:
        observation, info = self.env.reset(**options)
        return observation * np.array([1, 0.5, 0.5, 0.5, 0.5], np.float32), info

    def step(self, action: Any) -> Any:
        observation, *others = self.env.step(action)
        return observation * np.array([1, 0.5, 0.5, 0.5, 0.5], np.float32), *others


def test_a_wrapper_that_skips_frames_or_is_not_known_is_never_said_to_be_the_world(score: Callable[..., Any]) -> None:
    from stable_baselines3.common.atari_wrappers import MaxAndSkipEnv
    from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecMonitor, VecNormalize

    class HalvedBatch(VecEnvWrapper):
        def reset(self) -> Any:
            return self.venv.reset() * np.array([1, 0.5, 0.5, 0.5, 0.5], np.float32)

        def step_wait(self) -> Any:
            observation, *others = self.venv.step_wait()
            return observation * np.array([1, 0.5, 0.5, 0.5, 0.5], np.float32), *others

    def short() -> gymnasium.Env[Any, Any]:
        return make(max_steps=15)

    for env, name in (
        (gymnasium.wrappers.MaxAndSkipObservation(short(), skip=4), "MaxAndSkipObservation"),
        (MaxAndSkipEnv(short(), 4), "MaxAndSkipEnv"),
        (VecNormalize(VecNormalize(DummyVecEnv([short]))), "VecNormalize"),
    ):
        with pytest.raises(UserError, match=f"was trained behind {name}, which the world does not have"):
            score(trained("ppo", env))
    assert said(score(trained("ppo", Halved(short())))) == "unknown"
    assert said(score(trained("ppo", HalvedBatch(DummyVecEnv([short]))))) == "unknown"
    plain = gymnasium.wrappers.TimeLimit(gymnasium.wrappers.ClipReward(short(), 0, 1), 10)
    assert said(score(trained("ppo", VecMonitor(DummyVecEnv([lambda: plain]))))) == "highway(max_steps=15)"


def test_an_environment_with_another_configuration_is_another_world() -> None:
    pytest.importorskip("highway_env")
    from cavbench.driving.victims.sb3_environment import chain

    own = chain(gymnasium.make("highway-fast-v0"))
    for options, said in (
        ({}, []),
        ({"screen_width": 300}, []),
        ({"policy_frequency": 5}, ["policy_frequency=5"]),
        ({"lanes_count": 4, "duration": 9}, ["duration=9", "lanes_count=4"]),
    ):
        assert chain(gymnasium.make("highway-fast-v0", config=options))._differences(own) == said


def test_a_model_with_a_predict_of_its_own_is_refused() -> None:
    class Shifted(sb3.DQN):  # type: ignore[misc]
        def predict(self, *given: Any, **named: Any) -> Any:
            action, state = super().predict(*given, **named)
            return (action + 1) % 5, state

    refused(Shifted("MlpPolicy", make(), buffer_size=10, seed=0), r"Shifted has a predict\(\) of its own")


def test_a_file_of_a_model_that_divides_pictures_by_255_is_refused(tmp_path: Path) -> None:
    env = spaces(continuous=False, shape=(1, 10, 5))
    env.observation_space = gymnasium.spaces.Box(0, 255, (1, 10, 5), np.uint8)
    sb3.DQN("MlpPolicy", env, buffer_size=10, seed=0).save(tmp_path / "model.zip")
    refused(tmp_path / "model.zip", "was trained on pictures of uint8, which Stable-Baselines3 divides by 255")


def test_a_file_of_a_model_on_a_stack_of_frames_is_refused_unless_it_is_said(tmp_path: Path) -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

    model = trained("ppo", VecFrameStack(DummyVecEnv([make]), 2))
    model.save(tmp_path / "model.zip")
    refused(
        tmp_path / "model.zip",
        r"was trained on Box\(-1, 1, \(10, 10\)\), this world shows Box\(-1, 1, \(10, 5\)\).*if these are 2 frames",
    )
    refused(sb3.PPO.load(tmp_path / "model.zip"), r"if these are 2 frames, add victim.frames=2")


@pytest.mark.parametrize("shape", [(2, 5, 5), (5, 10), (1, 50), (25, 2), (5, 5), (15, 5)])
def test_a_model_of_another_shape_is_never_reshaped(shape: tuple[int, ...], tmp_path: Path) -> None:
    env = spaces(continuous=False, shape=shape)
    saved(tmp_path / "model.zip", "dqn", env)
    for given in (sb3_model("dqn", env), tmp_path / "model.zip"):
        refused(given, rf"was trained on Box\(-1, 1, \({', '.join(map(str, shape))}\)\), this world shows Box\(-1, 1")


def test_the_world_of_a_training_stands_in_the_records(score: Callable[..., Any]) -> None:
    network = nn.Sequential(nn.Flatten(), nn.Linear(50, 5))
    assert said(score(network)) == "unknown"
    assert said(score(network, trained_in="highway(preset=thesis)")) == "highway(preset=thesis)"
    model = trained("dqn", make(max_steps=15))
    assert said(score(model)) == "highway(max_steps=15)"
    assert said(score(trained("dqn", make(target_speeds=(20, 25, 30))))) == "highway(target_speeds=(20.0, 25.0, 30.0))"
    assert said(score(sb3_model("dqn", spaces(continuous=False)))) == "unknown"
    with pytest.raises(UserError, match="trained_in must be the world of the training as tables print it"):
        score(network, trained_in="in the highway")
    with pytest.raises(UserError, match="trained_in= is for a victim that is an object"):
        score("dqn", trained_in="highway")


def test_the_name_of_another_environment_stands_in_the_records(score: Callable[..., Any]) -> None:
    env = spaces(continuous=False)
    env.spec = gymnasium.spec("CartPole-v1")
    assert said(score(sb3_model("dqn", env))) == "CartPole-v1"


def test_the_identity_of_victims_of_the_zoo_says_nothing_new() -> None:
    # There `trained_in` is a part of the recipe: empty for the default world.
    assert json.loads(choose("victim", "dqn").params)["trained_in"] == ""
    assert "trained_in" not in parameters(type(choose("victim", "planner").component))
    written = WORLD.facts.written()
    assert not {"rows", "environment"} & set(written)


def test_a_file_is_refused_before_anything_is_driven(tmp_path: Path) -> None:
    path = saved(tmp_path / "m.zip", "dqn", spaces(continuous=False, shape=(5, 5)))["path"]
    words = f"attack=noise lanes=3 density=1 weather=clear episodes=1 victim=sb3 victim.path={path} executor=serial"
    heard: list[str] = []

    class Watch:
        def __getattr__(self, name: str) -> Callable[..., None]:
            return lambda *given, **named: heard.append(name)

    with pytest.raises(UserError, match=r"this world shows Box\(-1, 1, \(10, 5\)\)"):
        runner.run(plan_of([*words.split(), f"out={tmp_path}"]), Watch())  # type: ignore[arg-type]
    assert not heard


class Either(nn.Module):
    """Takes observations as rows or flattened, and reads them differently."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(50, 5)

    def forward(self, observation: Tensor) -> Tensor:
        flat = observation.transpose(1, 2).flatten(1) if observation.ndim == 3 else observation
        return self.linear(flat)


def test_a_network_that_takes_both_shapes_and_answers_differently_is_told_how_to_say_which() -> None:
    refused(Either(), r"differently; say which it takes: nn.Sequential\(nn.Flatten\(\), network\), or nn.Sequential\(")
    network = Either()
    observation = torch.from_numpy(OBSERVATION)
    for chosen, shown in (
        (nn.Sequential(nn.Flatten(), network), observation.flatten(1)),
        (nn.Sequential(nn.Unflatten(1, (10, 5)), network), observation),
    ):
        torch.testing.assert_close(loaded(chosen).scores(observation), network(shown).detach())


def test_the_complaints_about_both_shapes_are_said() -> None:
    refused(
        nn.Linear(25, 5),
        r"on \[4, 10, 5\] it fails \(RuntimeError: .*\); on \[4, 50\] it fails \(RuntimeError: .*4x50",
    )


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_a_network_of_another_precision_computes_in_float32(dtype: torch.dtype) -> None:
    network = nn.Sequential(nn.Flatten(), nn.Linear(50, 5)).to(dtype)
    observation = torch.from_numpy(OBSERVATION)
    scores = loaded(network).scores(observation)
    assert scores.dtype == torch.float32
    assert network[1].weight.dtype == dtype
    torch.testing.assert_close(scores, network(observation.to(dtype)).float(), rtol=0, atol=0.02)


class Exact(nn.Module):
    """Computes in float64 whatever it is given."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(50, 5).double()

    def forward(self, observation: Tensor) -> Tensor:
        return self.linear(observation.flatten(1).double())


class Half(Exact):
    """Computes in the precision that it is given, and holds a constant of its own in half precision."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(50, 5).half()
        self.shift = [torch.zeros(50, dtype=torch.float16)]

    def forward(self, observation: Tensor) -> Tensor:
        shown = observation.flatten(1)
        assert shown.dtype == torch.float16
        return self.linear(shown + self.shift[0])


@pytest.mark.parametrize("kind", [Exact, Half])
def test_a_network_that_needs_its_own_precision_keeps_it(kind: type[Exact]) -> None:
    network, observation = kind(), torch.from_numpy(OBSERVATION)
    scores = loaded(network).scores(observation)
    assert scores.dtype == torch.float32
    assert torch.equal(scores, network(observation.to(network.linear.weight.dtype)).float())


class Keeps(nn.Module):
    """Keeps its last distribution, as models of skrl do."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(50, 5)

    def forward(self, observation: Tensor) -> Tensor:
        self.last = torch.distributions.Categorical(logits=self.linear(observation.flatten(1)))
        return self.last.logits


def test_a_network_that_keeps_a_graph_is_told_what_to_do() -> None:
    network, observation = Keeps(), torch.from_numpy(OBSERVATION)
    network(observation)
    refused(network, r"Keeps cannot be copied \(RuntimeError: .*\); .* call it under torch.no_grad\(\) once")
    with torch.no_grad():
        network(observation)
    assert loaded(network).scores(observation).shape == (4, 5)


@pytest.mark.parametrize(("algorithm", "part"), [("sac", "actor"), ("sac", "policy"), ("ppo", "policy")])
def test_a_part_of_a_model_that_samples_its_actions_is_refused(algorithm: str, part: str) -> None:
    model = sb3_model(algorithm, spaces(continuous=True))
    refused(getattr(model, part), "is a part of a model of Stable-Baselines3: give the model itself")


def test_a_part_of_a_model_that_does_not_sample_is_a_network() -> None:
    model = sb3_model("dqn", spaces(continuous=False))
    observation = torch.from_numpy(OBSERVATION)
    torch.testing.assert_close(loaded(model.q_net).scores(observation), loaded(model).scores(observation))


def test_where_a_world_does_not_say_its_rows_the_policy_refuses_what_it_was_not_trained_on(tmp_path: Path) -> None:
    facts = dataclasses.replace(WORLD.facts, rows=None)
    policy = loaded(Path(saved(tmp_path / "m.zip", "dqn", spaces(continuous=False, shape=(5, 5)))["path"]), facts)
    assert policy.scores(torch.zeros(3, 5, 5)).shape == (3, 5)
    with pytest.raises(UserError, match=r"the policy takes observations \(5, 5\), this world shows \(10, 5\)"):
        policy.scores(torch.zeros(3, 10, 5))
    with pytest.raises(
        UserError, match=r"was trained on Box\(-1, 1, \(10, 7\)\), this world shows Box\(-1, 1, \(V, 5\)\)"
    ):
        loaded(Path(saved(tmp_path / "n.zip", "dqn", spaces(continuous=False, shape=(10, 7)))["path"]), facts)
