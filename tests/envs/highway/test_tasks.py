"""highway-env's own tasks: equal to its default environments, and a policy that was trained in them is at home."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import highway_env
import numpy as np
import pytest
import torch
from tensordict import TensorDict

import cavbench
import cavbench.gym
from cavbench.core.options import configured
from cavbench.core.pair import Pair, choose
from cavbench.core.track import Job, track
from cavbench.driving.threat import ObservationThreat
from cavbench.driving.victims.spaces import Bounds, Expected
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.tasks import HighwayFastV0, HighwayTask, HighwayV0
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from cavbench.records import reading

TASKS: dict[str, type[HighwayTask]] = {"highway-v0": HighwayV0, "highway-fast-v0": HighwayFastV0}
BOX = Bounds(shape=(5, 5), low=(-float("inf"),), high=(float("inf"),))
gymnasium.register_envs(highway_env)


def steps_of(task: HighwayTask, lanes: int, density: float, seed: int, actions: list[int]) -> list[tuple[Any, ...]]:
    """Observation, reward, terminated and truncated of every step here, until the episode ends."""
    env = task.make([AXES.cell(lanes=lanes, density=density)])
    state = env.reset(TensorDict({"seed": torch.tensor([seed])}, batch_size=[1]))
    found = [(state["observation"][0].numpy(), 0.0, False, False)]
    for action in actions:
        state = env.step(state.set("action", torch.tensor([action])))["next"]
        ends = state["terminated"].item(), state["truncated"].item()
        found.append((state["observation"][0].numpy(), state["reward"].item(), *ends))
        if any(ends):
            break
    return found


def steps_there(name: str, config: dict[str, Any], seed: int, actions: list[int]) -> list[tuple[Any, ...]]:
    """The same of highway-env itself."""
    env = gymnasium.make(name, config=config, disable_env_checker=True)
    found: list[tuple[Any, ...]] = [(env.reset(seed=seed)[0], 0.0, False, False)]
    for action in actions:
        found.append(env.step(action)[:4])
        if found[-1][2] or found[-1][3]:
            break
    return found


@pytest.mark.parametrize(
    ("name", "config", "seed", "calm"),
    [
        ("highway-fast-v0", {}, 0, True),
        ("highway-fast-v0", {"lanes_count": 5, "vehicles_density": 1.5}, 1_000_000, False),
        ("highway-fast-v0", {"duration": 9, "policy_frequency": 5, "vehicles_count": 9, "initial_lane_id": 1}, 7, True),
        (
            "highway-fast-v0",
            {
                "action": {"type": "DiscreteMetaAction", "target_speeds": [10, 20, 30]},
                "observation": {"type": "Kinematics", "vehicles_count": 7},
                "collision_reward": -3,
                "normalize_reward": False,
                "reward_speed_range": [15, 25],
            },
            8,
            False,
        ),
        ("highway-v0", {"vehicles_count": 20, "duration": 8}, 3, True),
    ],
)
def test_a_task_is_highway_envs(name: str, config: dict[str, Any], seed: int, calm: bool) -> None:
    generator = np.random.default_rng(seed)
    actions = generator.choice((4, 4, 4, 1, 2) if calm else (0, 1, 2, 3, 4), 46).tolist()
    axes = {"lanes_count": 4 if name == "highway-v0" else 3, "vehicles_density": 1.0} | config
    task = TASKS[name](
        config={key: value for key, value in config.items() if key not in ("lanes_count", "vehicles_density")}
    )
    here = steps_of(task, axes["lanes_count"], axes["vehicles_density"], seed, actions)
    there = steps_there(name, config, seed, actions)
    assert len(here) == len(there)
    for (seen, reward, *ends), (observation, earned, *over) in zip(here, there, strict=True):
        # numpy's AVX-512 kernels, where there are any, differ from scalar code in the last bit.
        np.testing.assert_allclose(seen, observation, rtol=0, atol=1e-6)
        assert seen.shape == observation.shape
        assert reward == pytest.approx(earned, abs=1e-6)
        assert ends == [bool(one) for one in over]


@pytest.mark.parametrize("name", TASKS)
def test_what_a_task_declares_is_what_highway_env_has(name: str) -> None:
    task, env = TASKS[name](), gymnasium.make(name)
    own = env.unwrapped.config
    assert dict(task.home) == {"lanes": own["lanes_count"], "density": own["vehicles_density"], "weather": "clear"}
    assert task.facts.decision_hz == own["policy_frequency"]
    assert task.facts.max_steps == own["duration"] * own["policy_frequency"]
    assert task.facts.rows == env.observation_space.shape[0]
    assert cavbench.gym.make(name).observation_space == env.observation_space
    assert cavbench.gym.make(name).action_space == env.action_space
    env.reset(seed=0)
    ranges = env.unwrapped.observation_type.features_range
    assert {
        n: [task.facts.features.physical(e * torch.ones(5))[i].tolist() for e in (-1, 1)] for i, n in enumerate(ranges)
    } == ranges
    assert TASKS[name](config=own).max_steps == task.max_steps


def test_y_ends_at_the_width_of_the_road() -> None:
    """Also in an attack's budget and in what a defence is told."""
    task = HighwayFastV0()
    assert [task.facts_at(AXES.cell(lanes=n, density=1.0)).features.high[1] for n in (3, 4, 5)] == [12, 16, 20]
    assert task.features.high == (200, 12, 80, 80)
    cells = [AXES.cell(lanes=n, density=1.0) for n in (3, 5)]
    observation = task.make(cells).reset(TensorDict({"seed": torch.tensor([5, 5])}, batch_size=[2]))["observation"]
    for row, cell in enumerate(cells):
        metres = task.facts_at(cell).features.physical(observation[row])
        lane = metres[0, 1].item() / 4
        assert lane == pytest.approx(round(lane), abs=1e-5)
    fixed = HighwayFastV0(
        config={
            "observation": {
                "type": "Kinematics",
                "features_range": {"x": [-100, 100], "y": [-20, 20], "vx": [-40, 40], "vy": [-20, 20]},
            }
        }
    )
    assert fixed.facts_at(cells[1]).features == fixed.facts.features
    assert fixed.features.high == (100, 20, 40, 20)


def test_roads_with_other_ranges_are_driven_in_other_batches() -> None:
    none = {kind: choose(kind, "none") for kind in ("attack", "defense")}
    for name, kinds in (("highway-fast-v0", 2), ("highway", 1)):
        pair = Pair(**none, victim=choose("victim", "blind"), world=choose("world", name), threat=ObservationThreat())
        jobs = [
            Job(pair=pair, training_seed=0, attack_seed=0, cell=AXES.cell(lanes=lanes, density=1.0), seeds=range(3))
            for lanes in (3, 4, 4)
        ]
        assert len({track("driving").alike(job) for job in jobs}) == kinds


def test_the_engine_and_the_reference_back_end_agree() -> None:
    ours, theirs = (
        HighwayFastV0(backend=backend).make([AXES.cell(lanes=4, density=1.5)]) for backend in ("batched", "reference")
    )
    states = [env.reset(TensorDict({"seed": torch.tensor([4])}, batch_size=[1])) for env in (ours, theirs)]
    for action in (0, 3, 2, 4, 1):
        states = [
            env.step(state.set("action", torch.tensor([action])))["next"]
            for env, state in zip((ours, theirs), states, strict=True)
        ]
        for key in states[0].keys(True, True):
            torch.testing.assert_close(states[0].get(key), states[1].get(key), rtol=1e-5, atol=1e-5)


def test_worlds_with_equal_configurations_are_equal() -> None:
    one, other = HighwayFastV0(config={"duration": 60}), HighwayFastV0(config='{"duration": 60}')
    assert one == other != HighwayFastV0()
    assert hash(one) == hash(other)
    chosen = choose("world", "highway-fast-v0", config={"duration": 60})
    assert str(chosen) == 'highway-fast-v0(config={"duration":60})'
    assert choose("world", "highway-fast-v0", **json.loads(chosen.params)) == chosen


def test_a_policy_of_highway_env_is_told_where_it_is_at_home() -> None:
    for task in TASKS.values():
        assert Expected(facts=task().facts).fit("dqn.zip", (5, 5), BOX) is None
    home = r"Box\(-inf, inf, \(5, 5\)\).*world=highway-fast-v0 or world=highway-v0; of another task, "
    with pytest.raises(UserError, match=home):
        Expected(facts=HighwayWorld().facts).fit("dqn.zip", (5, 5), BOX)
    ten = Bounds(shape=(10, 5), low=BOX.low, high=BOX.high)
    rows = r"'world.config=\{observation: \{vehicles_count: 10\}\}'; of another task, "
    for world in (HighwayWorld(), HighwayFastV0()):
        with pytest.raises(UserError, match=rows):
            Expected(facts=world.facts).fit("dqn.zip", (10, 5), ten)
    # A policy of cavbench's own highway is no policy of these.
    with pytest.raises(UserError, match=r'this world shows Box\(-inf, inf, \(5, 5\)\).*gym.make\("highway-fast-v0"\)'):
        Expected(facts=HighwayFastV0().facts).fit("dqn.zip", (10, 5), Bounds(shape=(10, 5), low=(-1.0,), high=(1.0,)))


def test_a_model_that_has_its_environment_says_in_which_task_it_was_trained(tmp_path: Path) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    options = {"lanes": 3, "density": 1, "weather": "clear", "episodes": 1, "baselines": False}
    found = []
    for number, config in enumerate(({}, {"lanes_count": 4}, {"duration": 20})):
        model = sb3.PPO("MlpPolicy", gymnasium.make("highway-fast-v0", config=config), n_steps=4, batch_size=4, seed=0)
        model.learn(4)
        cavbench.score(model, "none", world="highway-fast-v0", out=tmp_path / str(number), **options)
        records = reading.read(tmp_path / str(number), track=track("driving"))
        found.append(json.loads(records["victim_params"][0].as_py())["trained_in"])
    # Another road than those of the run is told, too.
    assert found == ["highway-fast-v0", "highway-fast-v0(lanes_count=4)", "highway-fast-v0(duration=20)"]


def test_a_preset_of_that_name_leads_to_the_world() -> None:
    with pytest.raises(ValueError, match=r"highway-env's own tasks are worlds: world=highway-fast-v0$"):
        HighwayWorld(preset="highway-fast-v0")  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"'highway-v0' is a world: write world=highway-v0$"):
        configured("world", "highway", {"preset": "highway-v0"})


def test_its_configuration_is_given_on_the_command_line_as_in_python() -> None:
    given = configured("world", "highway-v0", {"config": "{duration:60,observation:{vehicles_count:7}}"})
    assert given.component == HighwayV0(config={"duration": 60, "observation": {"vehicles_count": 7}})
    assert given.component.facts.max_steps == 60
    assert given.component.facts.rows == 7


def test_a_filter_and_an_attack_run_in_a_task(tmp_path: Path) -> None:
    options = {"lanes": [3, 4], "density": 1, "weather": ["clear", "fog"], "episodes": 2, "baselines": False}
    options["threat"] = {"access": "dynamics"}
    network = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(25, 5))
    cavbench.score(network, ["noise", "plan"], "shield", world="highway-fast-v0", out=tmp_path, **options)
    records = reading.read(tmp_path, track=track("driving"))
    highs = {
        (json.loads(cell)["lanes"], json.loads(facts)["features"]["high"][1])
        for cell, facts in zip(records["cell"].to_pylist(), records["world_facts"].to_pylist(), strict=True)
    }
    assert highs == {(3, 12.0), (4, 16.0)}
    assert max(records["excess_max"].to_pylist()) < 1e-6
