"""The world `gym`: registered environments as worlds, by their ids."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict

import cavbench
from cavbench.checks import complaints
from cavbench.core.pair import choose, label
from cavbench.driving import ObservationThreat
from cavbench.driving.gym import RegisteredWorld
from cavbench.errors import UserError
from cavbench.run import claims
from tests.command import Said
from tests.plugins.distributions import install

Bench = Callable[..., Said]
MERGE_ROW = ("presence0", "x0", "y0", "vx0", "vy0")


def made(**parameters: Any) -> Any:
    return cavbench.component("world", "gym", **parameters)


def test_the_tasks_of_highway_env_need_no_declaration() -> None:
    merge = made(id="merge-v0")
    features = merge.features
    assert features.names[:5] == MERGE_ROW
    assert (features.low[:2], features.high[:2]) == ((0.0, -1.0), (1.0, 1.0)), "the observation is normalised already"
    assert features.fixed == tuple(f"presence{row}" for row in range(5))
    assert features.present[5:10] == (-1, 5, 5, 5, 5)
    assert merge.actions == ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
    assert (merge.decision_hz, merge.max_steps) == (1.0, 40)
    assert merge.facts.shape == (5, 5)
    # 0.5 m of 200 m, and 0.2 m of the 8 m of its two lanes.
    assert features.floors[1:3] == (0.0025, 0.025)
    assert made(id="intersection-v0").actions == ("SLOWER", "IDLE", "FASTER")
    assert made(id="racetrack-v0").controls == ("steering",)


@pytest.mark.parametrize(
    ("name", "count", "ending"),
    [
        ("CartPole-v1", 4, "failure"),
        ("MountainCar-v0", 2, "success"),
        ("Pendulum-v1", 3, "failure"),
        ("Acrobot-v1", 6, "success"),
    ],
)
def test_the_classic_tasks_of_gymnasium_are_known(name: str, count: int, ending: str) -> None:
    world = made(id=name)
    assert len(world.features.names) == count
    assert np.isfinite([*world.features.low, *world.features.high]).all()
    assert world.ending == ending


def test_a_part_of_a_dict_is_attacked_and_all_parts_are_seen() -> None:
    world = made(id="parking-v0")
    free = [name for name in world.features.names if name not in world.features.fixed]
    assert free == ["x", "y", "vx", "vy", "cos_h", "sin_h"]
    assert len(world.features.names) == 18
    assert world.max_steps == 500
    env = world.make(world.own_grid().cells(), action_type="continuous")
    shown = world.facts.native(env.reset(TensorDict({"seed": torch.tensor([3])}, batch_size=[1]))["observation"])
    own = gymnasium.make("parking-v0")
    wanted = gymnasium.spaces.flatten(own.observation_space, own.reset(seed=3)[0])
    np.testing.assert_allclose(shown[0], wanted, atol=1e-6)
    goal = made(id="parking-v0", part="desired_goal").features
    assert set(goal.fixed) == set(goal.names) - {name for name in goal.names if name.startswith("desired_goal")}


def test_cells_come_from_the_keys_of_the_environment() -> None:
    world = made(id="highway-fast-v0", axes={"vehicles_density": [1, 2.5], "lanes_count": [3, 4]})
    cells = world.own_grid().cells()
    assert [dict(cell) for cell in cells] == [
        {"vehicles_density": density, "lanes_count": lanes} for density in (1.0, 2.5) for lanes in (3, 4)
    ]
    assert [world.environment(cell).unwrapped.config["lanes_count"] for cell in cells] == [3, 4, 3, 4]
    assert made(id="Pendulum-v1", axes={"g": [9.8, 12]}).own_grid().cells()[1].g == 12.0


def test_a_part_of_the_configuration_keeps_the_rest() -> None:
    world = made(id="merge-v0", config={"observation": {"vehicles_count": 3}, "high_speed_reward": 0.5})
    assert len(world.features.names) == 15
    config = world.environment(world.own_grid().cells()[0]).unwrapped.config
    assert config["observation"] == {"type": "Kinematics", "vehicles_count": 3}


@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        ({"id": "merg-v0"}, "no environment 'merg-v0'; did you mean 'merge-v0'?"),
        ({"id": "nowhere:X-v0"}, "there is no module 'nowhere', which world.id names"),
        ({"id": "merge-v0", "config": {"lane_count": 3}}, "unknown key 'lane_count' of the configuration of merge-v0"),
        ({"id": "Pendulum-v1", "config": {"gravity": 3}}, "unknown argument 'gravity' of Pendulum-v1; .*known: g"),
        ({"id": "merge-v0", "axes": {"lanes": []}}, "axes takes numbers or texts by the name of a setting"),
        ({"id": "merge-v0", "axes": {"screen_width": [1, 1]}}, "has a value twice"),
        ({"id": "merge-v0", "axes": 3}, "axes is a mapping such as"),
        ({"id": "merge-v0", "part": "observation"}, "has no parts: leave out world.part"),
        ({"id": "parking-v0", "part": "gaol"}, "no part 'gaol' that is measured: it has achieved_goal, desired_goal"),
        (
            {"id": "merge-v0", "features": {"z": [0, 1]}},
            "names 'z', .*name some of these, or all 25 entries or all 5 columns",
        ),
        ({"id": "merge-v0", "features": {"x": [1, 0]}}, r"the range of x is \[low, high\]"),
        ({"id": "merge-v0", "floors": {"z": 1}}, "world.floors names 'z'"),
        ({"id": "merge-v0", "fixed": ("q",)}, "world.fixed names 'q'"),
        ({"id": "merge-v0", "reward": (1, 0)}, r"reward is \[worst, best\]"),
        ({"id": "intersection-multi-agent-v0"}, r"takes actions of Tuple\(.*it must be Discrete or Box"),
        ({"id": "FrozenLake-v1"}, "an attacker can change nothing"),
    ],
)
def test_what_is_wrong_is_one_line(parameters: dict[str, Any], line: str) -> None:
    with pytest.raises(UserError, match=line):
        made(**parameters)


class Radar(gymnasium.Env[Any, Any]):
    """Sees a radar and a speed, apart, and has no limit of time."""

    observation_space = gymnasium.spaces.Dict({name: gymnasium.spaces.Box(-1, 1, (2,)) for name in ("radar", "speed")})
    action_space = gymnasium.spaces.Discrete(2)


def test_of_an_object_the_line_says_what_to_type_in_python() -> None:
    asked = []
    given: dict[str, Any] = {}
    for name, value in {"part": "radar", "max_steps": 9}.items():
        with pytest.raises(
            UserError, match=rf"; in Python: world=cavbench\.gym\.world\(env, {name}=\.\.\.\)$"
        ) as error:
            cavbench.gym.world(Radar(), **given)
        asked.append(str(error.value))
        given[name] = value
    assert set(cavbench.gym.world(Radar(), **given).features.fixed) == {"speed0", "speed1"}
    assert len(set(asked)) == 2


class Endless(gymnasium.Env[Any, Any]):
    """Sees two numbers without a range."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2, 2))
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.np_random.uniform(-3, 3, (2, 2)), {}

    def step(self, action: Any) -> Any:
        return self.np_random.uniform(-3, 3, (2, 2)), 1.0, False, False, {}


@pytest.mark.parametrize(
    ("features", "names", "lows"),
    [
        ({"u": [-3, 3], "v": [-4, 4]}, ("u0", "v0", "u1", "v1"), (-3, -4, -3, -4)),
        ({"a": [-3, 3], "b": [-4, 4], "c": [-5, 5], "d": [-6, 6]}, ("a", "b", "c", "d"), (-3, -4, -5, -6)),
    ],
)
def test_ranges_are_given_by_columns_or_by_entries(features: Any, names: Any, lows: Any) -> None:
    with pytest.raises(UserError, match=r"the range of o0_0, o0_1, o1_0 and 1 more is not known: .*world.features="):
        cavbench.gym.world(Endless, max_steps=5)
    with pytest.raises(UserError, match=r"has no limit of time: write world\.max_steps="):
        cavbench.gym.world(Endless, features=features)
    found = cavbench.gym.world(Endless, max_steps=5, features=features).features
    assert found.names == names
    assert found.low == lows


def test_records_say_what_was_given_in_its_order() -> None:
    chosen = choose("world", "gym", id="CartPole-v1", features={"spin": [-5, 5], "angle": [-1, 1]})
    params = json.loads(chosen.params)
    assert list(params["features"]) == ["spin", "angle"]
    assert choose("world", "gym", **params).component == chosen.component
    assert label("world", "gym", params) == str(chosen)


def test_who_arrives_has_not_crashed_and_sooner_is_better() -> None:
    world = made(id="MountainCar-v0")
    env = world.make(world.own_grid().cells())
    td = env.reset(TensorDict({"seed": torch.tensor([5])}, batch_size=[1]))
    progress, steps = 0.0, 0
    while not td["done"].item():
        # Along with the speed it swings up the hill.
        push = 2 if td["observation"][0, 0, 2] >= 0 else 0
        td = env.step(td.set("action", torch.tensor([push])))["next"]
        progress, steps = progress + td["info", "progress"].item(), steps + 1
    assert td["terminated"].item()
    assert not td["info", "crashed"].item()
    assert progress == 200 - steps > 0
    assert not [line for line in world.doubts(world.own_grid().cells()) if "arrived" in line]


@pytest.mark.parametrize(("ending", "lines"), [("unknown", 1), ("failure", 0), ("success", 0)])
def test_an_end_that_cannot_be_read_is_asked_for(ending: Any, lines: int) -> None:
    world = cavbench.gym.world(Endless, max_steps=5, features={"u": [-3, 3], "v": [-3, 3]}, terminated=ending)
    told = [line for line in world.doubts(world.own_grid().cells()) if "has failed or arrived" in line]
    assert len(told) == lines
    assert world.failed(True, {"reward": 1.0}) == (ending != "success")
    assert not world.failed(False, {"reward": 1.0})
    by_reward = cavbench.gym.world(Endless, max_steps=5, features={"u": [-3, 3], "v": [-3, 3]}, terminated="reward")
    assert [by_reward.failed(True, {"reward": reward}) for reward in (100.0, -100.0)] == [False, True]


def test_an_intersection_made_before_changes_no_traffic() -> None:
    def driven() -> list[float]:
        world = made(id="merge-v0")
        env = world.make(world.own_grid().cells())
        td = env.reset(TensorDict({"seed": torch.tensor([1])}, batch_size=[1]))
        rewards = []
        for _ in range(8):
            td = env.step(td.set("action", torch.tensor([1])))["next"]
            rewards += td["observation"].flatten().tolist()
        return rewards

    first = driven()
    gymnasium.make("intersection-v0").reset(seed=0)
    assert driven() == first


def test_what_is_absent_nobody_can_fill() -> None:
    world = made(id="merge-v0")
    env = world.make(world.own_grid().cells())
    seen = env.reset(TensorDict({"seed": torch.tensor([1])}, batch_size=[1]))["observation"]
    seen[0, 0, 1 + 20 : 1 + 25] = torch.tensor([-1.0, 0, 0, 0, 0])
    for norm in ("relative", "linf"):
        radius = ObservationThreat(norm=norm).radius(seen, world.features)[0, 0, 1:]  # type: ignore[arg-type]
        assert (radius[20:] == 0).all()
        assert (radius[torch.arange(25) % 5 == 0] == 0).all(), "presence"
        assert (radius[1:5] > 0).all()


def saved(path: Path, entries: int, actions: int) -> Path:
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(entries, actions)).eval()
    batch = torch.export.Dim("batch", min=1, max=100_000)
    program = torch.export.export(network, (torch.zeros(3, entries),), dynamic_shapes=({0: batch},))
    torch.export.save(program, path)
    return path


@pytest.mark.slow
def test_the_command_line_drives_checks_and_replays_it(bench: Bench, tmp_path: Path) -> None:
    policy = saved(tmp_path / "cart.pt2", 4, 2)
    words = [
        "world=gym", "world.id=CartPole-v1", "world.max_steps=40", "world.features={spin: [-5, 5]}",
        "victim=torch", f"victim.path={policy}", "attack=pgd", "attack.objective=margin", "attack.steps=2",
    ]  # fmt: skip
    run = bench("run", *words, "episodes=2", "workers=1", f"out={tmp_path / 'out'}")
    assert run.code == 0, run.err
    again = bench(
        "view", str(tmp_path / "out"), "attack=pgd", "--save", str(tmp_path / "film.gif"), f"out={tmp_path / 'out'}"
    )
    assert "differ" not in again.out + again.err
    assert complaints("world", "gym", id="CartPole-v1") == []


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["attack=plan", "threat.access=dynamics"],
            "attack 'plan' does not fit world 'gym': it needs the dynamics of the world",
        ),
        (
            ["attack=pessimist", "world.id=Pendulum-v1"],
            "attack 'pessimist' does not fit world 'gym': it needs the features x, vx",
        ),
        (
            ["attack=pgd"],
            "its objective collision spares the action that brakes, number 4 .*: write attack.objective=margin",
        ),
        (
            ["attack=noise", "defense=shield"],
            "defense 'shield' does not fit world 'gym': it needs to know how .* cars move",
        ),
        (["attack=noise", "defense=tracker+shield"], "does not fit world 'gym'"),
        (["attack=noise", "grid=standard-v2"], "whose cells follow from its parameters: leave out grid"),
        (["attack=noise", "world.id=CartPole-v1,Pendulum-v1"], "a run uses one world"),
    ],
)
def test_what_is_missing_in_it_is_said_at_once(bench: Bench, words: list[str], line: str, tmp_path: Path) -> None:
    given = [] if any(word.startswith("world.id") for word in words) else ["world.id=CartPole-v1"]
    said = bench("run", "world=gym", *given, "victim=torch", "victim.path=none.pt2", *words, f"out={tmp_path}")
    assert said.code == 2
    assert said.err.count("\n") == 1
    assert re.search(line, said.err)


@pytest.mark.parametrize("name", ["CartPole-v1", "Acrobot-v1"])
def test_a_network_of_the_zoo_is_refused_where_its_features_are_others_be_they_as_many(bench: Bench, name: str) -> None:
    said = bench("run", "world=gym", f"world.id={name}", "attack=noise", "victim=dqn")
    assert said.code == 2
    assert "it was trained on x, y, vx, vy, this world measures " in said.err.splitlines()[-1]


def test_the_id_of_an_environment_is_no_name_of_a_world(bench: Bench) -> None:
    said = bench("run", "world=merge-v0")
    assert "a gymnasium environment is given as world=gym world.id=merge-v0" in said.err


def test_a_module_of_a_package_is_imported_and_a_sender_may_not_name_one(plugins: Path) -> None:
    code = (
        "import gymnasium\n"
        "from gymnasium.envs.classic_control.cartpole import CartPoleEnv\n"
        "class Mine(CartPoleEnv):\n    pass\n"
        'gymnasium.register("Mine-v0", entry_point="my_envs:Mine", max_episode_steps=30)\n'
    )
    install(plugins, "my_envs", {}, {"my_envs": code})
    world = made(id="my_envs:Mine-v0", features={"o1": [-4, 4], "o3": [-4, 4]}, terminated="failure")
    assert world.max_steps == 30
    assert world.modules()[1] == "my_envs"
    record = {"world": "gym", "world_params": json.dumps({"id": "my_envs:Mine-v0"})}
    with pytest.raises(UserError, match="imports the module my_envs, which no plug-in of cavbench is"):
        claims._check_imports(record)
    claims._check_imports(record | {"world_params": json.dumps({"id": "merge-v0"})})


def test_worlds_of_one_id_are_equal_and_can_be_keys() -> None:
    first, second = (made(id="CartPole-v1", axes={"sutton_barto_reward": [0, 1]}) for _ in range(2))
    assert isinstance(first, RegisteredWorld)
    assert first == second
    assert len({first, second}) == 1


def driven(predict: Any, env: Any, seed: int, steps: int) -> float:
    """The return of a model in its own environment."""
    observation, _ = env.reset(seed=seed)
    total = 0.0
    for _ in range(steps):
        action, _ = predict(observation)
        observation, reward, terminated, truncated, _ = env.step(action if np.ndim(action) else int(action))
        total += float(reward)
        if terminated or truncated:
            break
    return total


@pytest.mark.slow
def test_models_of_their_libraries_earn_here_what_they_earn_there(tmp_path: Path) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    vec = pytest.importorskip("stable_baselines3.common.vec_env")
    parts = sb3.SAC(
        "MultiInputPolicy", gymnasium.make("highway_env:parking-v0"), learning_starts=5, seed=0, device="cpu"
    )
    parts.learn(8)
    venv = vec.VecNormalize(vec.DummyVecEnv([lambda: gymnasium.make("CartPole-v1")]), norm_reward=False)
    scaled = sb3.PPO("MlpPolicy", venv, n_steps=32, batch_size=32, seed=0, device="cpu").learn(32)
    venv.training = False
    scaled.save(tmp_path / "model.zip")
    venv.save(tmp_path / "statistics.pkl")
    saved = cavbench.component(
        "victim", "sb3", path=str(tmp_path / "model.zip"), normalize=str(tmp_path / "statistics.pkl")
    )

    def normalised(observation: Any) -> Any:
        return scaled.predict(venv.normalize_obs(observation), deterministic=True)

    for name, victim, predict, steps in (
        ("highway_env:parking-v0", parts, lambda seen: parts.predict(seen, deterministic=True), 10),
        ("CartPole-v1", scaled, normalised, 60),
        ("CartPole-v1", saved, normalised, 60),
    ):
        world = cavbench.gym.world(name, max_steps=steps)
        found = cavbench.score(victim, "none", world=world, episodes=2, baselines=False, out=tmp_path / "out").records
        for seed, total in zip(found["seed"], found["return"], strict=True):
            assert total == pytest.approx(driven(predict, gymnasium.make(name), int(seed), steps), abs=1e-4)
