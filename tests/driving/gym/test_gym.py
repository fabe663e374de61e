"""Driving worlds as gymnasium environments, and the CartPole world of the documentation."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict

import cavbench
from cavbench.checks import complaints
from cavbench.core import registry
from cavbench.driving import DrivingAttack, Features
from cavbench.gym import GymWorld
from cavbench.scenarios import Axes, Axis, Cell, Grid, SeedBlock
from tests.command import Said
from tests.plugins.distributions import install
from tests.tree import ROOT

Bench = Callable[..., Said]
PAGE = ROOT / "docs" / "gymnasium.md"
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


def test_a_list_of_seeds_gives_each_episode_its_own() -> None:
    options = {"num_envs": 4, "max_steps": 4, **CELL, "lanes": [3, 4]}
    envs = cavbench.gym.make_vec("highway", **options)
    alone = [cavbench.gym.make("highway", max_steps=4, **CELL | {"lanes": cell.lanes}) for cell in envs.cells]
    seen, info = envs.reset(seed=[1, 9, 9, 9])
    starts = [env.reset(seed=seed) for env, seed in zip(alone, [1, 9, 9, 9], strict=True)]
    assert info["cell"]["lanes"].tolist() == [3, 4, 3, 4]
    for step in range(11):
        for place, (observation, truth) in enumerate(starts):
            assert (seen[place] == observation).all(), f"episode {place} in step {step}"
            assert truth["scenario"] == info["scenario"][place]
        seen, _, _, truncated, info = envs.step(np.array([1, 1, 3, 4]))
        # A reset is a step of its own (NEXT_STEP).
        begins = step % 5 == 4
        assert truncated.all() == (step % 5 == 3)
        starts = [env.reset() if begins else env.step(a)[::4] for env, a in zip(alone, [1, 1, 3, 4], strict=True)]
    numbered, again = (envs.reset(seed=seed)[0].copy() for seed in (7, np.array([7, 8, 9, 10])))
    assert (numbered == again).all(), "as gymnasium: seed, seed + 1, ..."


def test_a_mask_starts_some_episodes() -> None:
    envs = cavbench.gym.make_vec("highway", num_envs=3, **CELL)
    with pytest.raises(cavbench.UserError, match="the first reset starts all episodes"):
        envs.reset(options={"reset_mask": np.array([True, False, False])})
    envs.reset(seed=[4, 5, 6])
    before, *_ = envs.step(np.array([3, 3, 3]))
    after, info = envs.reset(seed=[8, 8, 8], options={"reset_mask": np.array([True, False, True])})
    assert info["_scenario"].tolist() == [True, False, True]
    assert (after[1] == before[1]).all()
    fresh, _ = cavbench.gym.make("highway", **CELL).reset(seed=8)
    assert (after[0] == fresh).all()
    assert (after[2] == fresh).all()
    assert envs.np_random_seed == (8, 5, 8)


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        ({"seed": [1, 2]}, "one for each of the 3 episodes, got 2"),
        ({"seed": [1, -2, 3]}, "at least 0, got -2"),
        ({"seed": -1}, "at least 0, got -1"),
        ({"seed": 1.5}, "at least 0, got 1.5"),
        ({"seed": [True, 1, 1]}, "at least 0, got True"),
        ({"options": {"lanes": 4}}, "option 'reset_mask' only, got 'lanes'"),
        ({"options": {"reset_mask": np.zeros(3, bool)}}, "at least one True"),
        ({"options": {"reset_mask": np.ones(2, bool)}}, r"of shape \[3\]"),
    ],
)
def test_what_a_reset_cannot_do_is_refused(asked: dict[str, Any], line: str) -> None:
    envs = cavbench.gym.make_vec("highway", num_envs=3, **CELL)
    envs.reset(seed=0)
    with pytest.raises(cavbench.UserError, match=line):
        envs.reset(**asked)
    if "reset_mask" not in str(asked) and not isinstance(asked.get("seed"), list):
        with pytest.raises(cavbench.UserError, match=r"at least 0|takes no options"):
            cavbench.gym.make("highway", **CELL).reset(**asked)


@pytest.mark.parametrize("bad", [np.array([1.5, 1, 1]), np.array([1, 1]), 3, np.array([True, False, True])])
def test_actions_of_another_kind_are_refused(bad: Any) -> None:
    envs = cavbench.gym.make_vec("highway", num_envs=3, **CELL)
    envs.reset(seed=0)
    with pytest.raises(cavbench.UserError, match=r"discrete actions are whole numbers of shape \[3\]"):
        envs.step(bad)


def test_the_first_example_of_the_page_runs(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    code = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[0]
    for long, short in (("20_000", "250"), ("episodes=20", f"episodes=1, out={str(tmp_path)!r}, baselines=False")):
        assert long in code
        code = code.replace(long, short)
    exec(code, {})


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
    install_cartpole(plugins, page_code())
    import cartpole  # type: ignore[import-not-found]

    yield cartpole
    del sys.modules["cartpole"]


def page_code() -> str:
    """The module of the page."""
    return next(
        block for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL) if "GymWorld)" in block
    )


def install_cartpole(plugins: Path, code: str) -> None:
    points = {
        "cavbench.worlds": {"cartpole": "cartpole:CartPole"},
        "cavbench.grids": {"cartpole-v1": "cartpole:CARTPOLE_V1"},
    }
    install(plugins, "cartpole", points, {"cartpole": code})
    registry.installed.cache_clear()
    sys.modules.pop("cartpole", None)


class Road(gymnasium.Env[Any, Any]):
    """Ten steps of a grid of numbers; what it returns and says is set from outside."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2, 3), np.float64)

    def __init__(self, world: Any) -> None:
        self.world, self.action_space = world, gymnasium.spaces.Discrete(2, start=5)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.time = 0
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        assert action in (5, 6)
        self.time += 1
        told = self.world.tells(self.time, action)
        return self._seen(), self.world.reward, self.time == self.world.ends, False, told

    def _seen(self) -> Any:
        drawn = self.np_random.uniform(-1, 1, (2, 3))
        drawn[:, 0] = 1.0
        return drawn


AXIS = Axes((Axis(name="width", kind="int", meaning="of nothing", low=1, high=9),))
ROAD_V1 = Grid(name="road-v1", world="road", axes=AXIS, values={"width": (3,)}, episodes=4)


@dataclass(frozen=True, kw_only=True)
class RoadWorld(GymWorld):
    """Two rows of three numbers.

    Args:
        max_steps: decisions.
        reward: of each step.
        ends: the step that terminates.
    """

    axes: ClassVar[Axes] = AXIS
    grid: ClassVar[str] = "road-v1"
    features: ClassVar[Features] = Features(
        names=("there0", "x0", "y0", "there1", "x1", "y1"),
        low=(0.0, -1.0, -1.0) * 2, high=(1.0, 1.0, 1.0) * 2, units=("", "m", "rad") * 2, fixed=("there0", "there1"),
    )  # fmt: skip
    actions: ClassVar[tuple[str, ...]] = ("A", "B")
    hz: ClassVar[float] = 1.0
    terminated: ClassVar[Any] = "failure"
    tells: ClassVar[Callable[[int, int], dict[str, Any]]] = staticmethod(lambda time, action: {})

    max_steps: int = 10
    reward: float = 0.5
    ends: int = 10

    def environment(self, cell: Cell) -> gymnasium.Env[Any, Any]:
        return Road(self)


def told(
    world: type[RoadWorld] = RoadWorld, /, says: Callable[[int, int], dict[str, Any]] | None = None, **changes: Any
) -> Any:
    """A world with other class attributes; `says` is what its environment tells in `info`."""
    parts = changes | ({"tells": staticmethod(says)} if says else {})
    return type("Told", (world,), parts)


def scored(world: RoadWorld, tmp_path: Path, attack: Any = "none", **options: Any) -> Any:
    network = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(6, 2))
    return cavbench.score(
        network, attack, world=world, grid=ROAD_V1, episodes=3, seeds=[0], actions="discrete", out=tmp_path, **options
    )


@pytest.mark.parametrize(
    ("says", "terminated", "failed"),
    [
        ({}, True, True),
        ({}, False, False),
        ({"crashed": True}, False, True),
        ({"crashed": False}, True, False),
        ({"crashed": np.False_, "rewards": {"on_road_reward": 0.0}}, True, True),
        ({"crashed": False, "rewards": {"on_road_reward": True}}, True, False),
        ({"is_success": False}, False, False),
        ({"is_success": False}, True, True),
        ({"is_success": True}, True, False),
        ({"success": 1.0}, True, False),
        ({"crashed": True, "is_success": True}, True, True),
        ({"crashed": False, "is_success": False}, True, True),
    ],
)
def test_failing_is_what_the_environment_tells(says: dict[str, Any], terminated: bool, failed: bool) -> None:
    assert RoadWorld().failed(terminated, says) is failed


def test_who_arrives_has_not_crashed(tmp_path: Path) -> None:
    """As in merge-v0, where every driver terminates."""
    arrives = told(says=lambda time, action: {"crashed": action == 6})()
    found = scored(arrives, tmp_path).set_index("victim")
    assert found.loc["blind(policy=a)" if "blind(policy=a)" in found.index else "blind", "crashed"] == 0.0
    assert found.loc["blind(policy=b)", "crashed"] == 1.0


def test_an_array_of_several_dimensions_is_shown_as_it_is() -> None:
    world = RoadWorld()
    env = world.make(ROAD_V1.cells() * 3)
    seen = env.reset(TensorDict({"seed": torch.arange(3)}, batch_size=[3]))["observation"]
    assert seen.shape == (3, 1, 7)
    native = world.facts.native(seen)
    assert native.shape == (3, 2, 3)
    for place in range(3):
        torch.testing.assert_close(
            native[place].double(), torch.from_numpy(Road(world).reset(seed=place)[0]), rtol=0, atol=1e-6
        )
    assert "shape" not in world.facts.written(), "records are as before"


def test_a_shape_that_cannot_be_asked_for_must_be_declared() -> None:
    def cautious(self: Any, cell: Any) -> Any:
        if cell.width != 3:
            raise RuntimeError("only three")
        return Road(self)

    shy = told(environment=cautious)
    assert shy().facts.shape == (6,)
    with pytest.raises(cavbench.UserError, match=r"observes arrays \[2, 3\], not \[6\]: write shape: ClassVar"):
        shy().make(ROAD_V1.cells())
    assert told(environment=cautious, shape=(2, 3))().make(ROAD_V1.cells()).batch_size == (1,)


@pytest.mark.parametrize("threat", [{"norm": "linf", "budget": 0.5}, {"norm": "relative", "budget": 0.9}])
def test_nobody_forges_a_fixed_feature(threat: dict[str, Any], tmp_path: Path) -> None:
    class Liar(DrivingAttack):
        access: ClassVar[Any] = "oblivious"

        def perturb(self, observation: torch.Tensor, oracle: Any) -> torch.Tensor:
            assert oracle.radius[..., [0, 1, 4]].abs().max() == 0 < oracle.radius[..., [2, 3, 5, 6]].max()
            return -torch.ones_like(observation)

    class Honest(torch.nn.Module):
        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            """Action 0 where both rows are there."""
            there = observation[..., 0].sum(-1) - 1.999
            return torch.stack([there, -there], -1)

    found = cavbench.score(
        Honest(), dataclass(frozen=True, kw_only=True)(Liar)(), world=RoadWorld(), grid=ROAD_V1, episodes=2, seeds=[0],
        actions="discrete", out=tmp_path, threat=threat, baselines=False,
    )  # fmt: skip
    rows = found.records[found.records.attack == "Liar"]
    assert np.stack(rows.action_counts).sum(0).tolist() == [20, 0], "it is shown that both rows are there"
    assert rows.linf_m.max() > 0
    assert rows.linf_mps.max() == 0, "radians are not metres a second"
    assert '"fixed":["there0","there1"]' in rows.world_facts.iloc[0]


def test_a_fixed_feature_has_a_name() -> None:
    with pytest.raises(ValueError, match=r"features\.fixed names 'y'"):
        Features(("x",), (0.0,), (1.0,), ("",), fixed=("y",))
    assert "fixed" not in Features(("x",), (0.0,), (1.0,), ("",)).written(), "built-in worlds are written as before"


WIDE = replace(RoadWorld.features, low=(0.0, -200.0, -1.0) * 2, high=(1.0, 200.0, 1.0) * 2)
NARROW = replace(RoadWorld.features, low=(0.0, -0.5, -1.0) * 2, high=(1.0, 0.5, 1.0) * 2)


@pytest.mark.parametrize(
    ("world", "line"),
    [
        (told()(), ""),
        (
            told(features=WIDE)(),
            r"the declared range of x0 \(-200 to 200, seen -\S+ to \S+\) and x1 .*is used by less than 5 %",
        ),
        (
            told(features=NARROW)(),
            r"the declared range of x0 \(-0.5 to 0.5, seen .* is left by more than 1 % of the values",
        ),
        (told()(reward=-3.0), r"100 % of the rewards are outside \[0, 1\] \(-3 to -3 in 1000 random steps\)"),
        (told(progress=lambda self, reward, info: 0.5)(reward=-3.0), ""),
        (
            told(environment=lambda self, cell: gymnasium.wrappers.TimeLimit(Road(self), 4))(),
            "ends every episode after 4 steps, but max_steps is 10: no safe_progress can be above 0.4; write max_steps=4",
        ),
    ],
)
def test_random_steps_say_what_is_declared_wrongly(world: RoadWorld, line: str) -> None:
    said = replace(world, ends=0).doubts(ROAD_V1.cells())
    assert len(said) == bool(line)
    assert re.search(line, " ".join(said))


def test_a_run_says_it_before_the_baselines_are_driven(tmp_path: Path) -> None:
    driven: list[str] = []

    class Slow(told(features=WIDE)):  # type: ignore[misc]
        def progress(self, reward: float, info: Any) -> float:
            driven.append("a step")
            return 0.5

    object.__setattr__(world := Slow(ends=3), "features", WIDE)
    with pytest.warns(UserWarning, match="range of x0") as said:
        scored(world, tmp_path)
    lines = [str(each.message) for each in said]
    assert lines[0].startswith("world Slow(ends=3): the declared range of x0")
    assert "every baseline fails in every episode (a, b, random; 9 episodes)" in lines[-1]
    assert len(lines) == 2


def test_a_progress_outside_its_range_is_refused(tmp_path: Path) -> None:
    with pytest.raises(cavbench.UserError, match=r"progress returned 3: return a share in \[0, 1\]"):
        scored(told(progress=lambda self, reward, info: 3.0)(), tmp_path, baselines=False)


def test_bench_check_asks_to_look_at_wrong_ranges(plugins: Path, bench: Bench) -> None:
    install_cartpole(plugins, page_code().replace("(4.8, 4.0,", "(480.0, 4.0,"))
    said = bench("check", "cartpole")
    assert said.code == 0, "a doubt is no broken rule"
    assert "1 to look at" in said.out
    assert re.search(r"doubts +\? look +.*the declared range of x \(-4.8 to 480,", said.out)


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
    assert scored(gymnasium.make("CartPole-v1", sutton_barto_reward=True)) == "CartPole-v1(sutton_barto_reward=True)"
    with pytest.raises(cavbench.UserError, match="was trained behind TransformObservation, which the world does not"):
        scored(gymnasium.wrappers.TransformObservation(own, np.tanh, own.observation_space))
    with pytest.raises(
        cavbench.UserError, match=r"was trained on Box\(-inf, inf, \(4,\)\), this world shows Box\(\[-4.8"
    ):
        scored(gymnasium.wrappers.NormalizeObservation(own))
    # cavbench.gym.make gives one row on [-1, 1], which such a policy is given, too.
    assert scored(cavbench.gym.make(world, pole=0.5)) == "cartpole(max_steps=20)"


def test_a_trained_off_policy_model_is_scored_in_the_environment_of_its_training(cartpole: Any, tmp_path: Path) -> None:
    # Stable-Baselines3 keeps an observation "before VecNormalize" of these models even if there was none.
    sb3 = pytest.importorskip("stable_baselines3")
    world = cartpole.CartPole(max_steps=20)
    env = world.environment(cartpole.CARTPOLE_V1.cells()[0])
    model = sb3.DQN("MlpPolicy", env, learning_starts=5, buffer_size=50, seed=0).learn(20)
    model.save(tmp_path / "model.zip")
    file = cavbench.component("victim", "sb3", path=str(tmp_path / "model.zip"))
    for victim, said in (
        (model, "cartpole(max_steps=20)"),
        (sb3.DQN.load(tmp_path / "model.zip"), "unknown"),
        (file, "unknown"),
    ):
        found = cavbench.score(victim, "none", world=world, pole=0.5, episodes=1, baselines=False, out=tmp_path)
        assert json.loads(found.records.victim_params.iloc[0])["trained_in"] == said
    with pytest.raises(
        cavbench.UserError, match="nothing tells whether it was trained behind VecNormalize: load it without"
    ):
        cavbench.score(
            sb3.DQN.load(tmp_path / "model.zip", env=env), "none", world=world, pole=0.5, episodes=1, out=tmp_path
        )


class Unseeded(gymnasium.Wrapper):  # type: ignore[type-arg]
    """Does not pass the seed on."""

    def reset(self, **options: Any) -> Any:
        return self.env.reset()


class SharedWind(gymnasium.Wrapper):  # type: ignore[type-arg]
    """A wind that all carts share."""

    time: ClassVar[int] = 0

    def reset(self, **options: Any) -> Any:
        SharedWind.time = 0
        return self.env.reset(**options)

    def step(self, action: Any) -> Any:
        SharedWind.time += 1
        found: Any = self.env.unwrapped
        found.state = tuple(np.add(found.state, (0, 0.05 * np.sin(SharedWind.time), 0, 0)))
        return self.env.step(action)


@pytest.mark.parametrize(
    ("wrap", "line"),
    [
        (lambda env: env, ""),
        (Unseeded, "is reset with the same seed goes on otherwise"),
        (SharedWind, "are driven in turn change each other"),
        (gymnasium.wrappers.NormalizeObservation, "depends on those before it in the same environment"),
    ],
)
def test_an_environment_whose_episodes_are_not_the_same_again_is_told(cartpole: Any, wrap: Any, line: str) -> None:
    class Wrapped(cartpole.CartPole):  # type: ignore[misc]
        def environment(self, cell: Any) -> Any:
            return wrap(super().environment(cell))

    told = [one for one in Wrapped().doubts(cartpole.CARTPOLE_V1.cells()) if "Wrapped" in one]
    assert len(told) == bool(line)
    assert line in "".join(told)


class OfOldGym(gymnasium.Wrapper):  # type: ignore[type-arg]
    """Has one kind of end, as environments of gym 0.21."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated or truncated, False, info


@pytest.mark.parametrize(("wrap", "told"), [(lambda env: env, 0), (OfOldGym, 1)])
def test_an_end_of_time_that_counts_as_a_failure_is_told(cartpole: Any, wrap: Any, told: int) -> None:
    class Wrapped(cartpole.CartPole):  # type: ignore[misc]
        def environment(self, cell: Any) -> Any:
            return wrap(super().environment(cell))

    found = Wrapped(max_steps=20).doubts(cartpole.CARTPOLE_V1.cells())
    assert sum("that reached max_steps count as failed" in line for line in found) == told


def test_one_environment_for_all_episodes_is_refused(cartpole: Any) -> None:
    cells = cartpole.CARTPOLE_V1.cells()
    only = cartpole.CartPole().environment(cells[0])

    class Same(cartpole.CartPole):  # type: ignore[misc]
        def environment(self, cell: Any) -> Any:
            return only

    with pytest.raises(cavbench.UserError, match="returned the same environment for two episodes"):
        Same().make(cells)


def test_an_environment_that_is_not_as_declared_is_refused(cartpole: Any) -> None:
    class Other(cartpole.CartPole):  # type: ignore[misc]
        def environment(self, cell: Any) -> Any:
            return gymnasium.make("MountainCar-v0")

    with pytest.raises(cavbench.UserError, match="declares 4 features, its environment observes Box"):
        Other().make(cartpole.CARTPOLE_V1.cells())
