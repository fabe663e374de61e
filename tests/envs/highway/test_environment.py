"""The TorchRL environments: specs, resets, seeds, mixed batches, held actions, and one backend against the other."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import gymnasium
import pytest
import torch
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from cavbench.driving import ActionType, Driver
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.world import Backend, HighwayWorld
from cavbench.errors import UserError
from cavbench.scenarios import Cell, SeedBlock
from tests.tree import ROOT

PAGE = ROOT / "docs" / "worlds" / "highway.md"
CLEAR = AXES.cell(lanes=3, density=1.0)
MIXED = (CLEAR, AXES.cell(lanes=4, density=2.0, weather="rain"), AXES.cell(lanes=5, density=1.0, weather="fog"))
IDLE, LANE_RIGHT, FASTER, SLOWER = 1, 2, 3, 4


def make(cells: Sequence[Cell] = (CLEAR,), **options: Any) -> EnvBase:
    """An environment of a small world; options are passed to `make` if it has them, otherwise to the world."""
    of_make = {name: options.pop(name) for name in ("action_type", "driver", "action_repeat") if name in options}
    return HighwayWorld(**options).make(cells, **of_make)


def start(env: EnvBase, *seeds: int) -> TensorDictBase:
    return env.reset(TensorDict({"seed": torch.tensor(seeds)}, batch_size=[len(seeds)]))


def drive(env: EnvBase, state: TensorDictBase, actions: Tensor) -> list[TensorDictBase]:
    """Step through actions [T, ...] (or [T, B, ...]) and return the output of each step."""
    results = []
    for action in actions:
        shape = env.action_spec.shape
        results.append(env.step(TensorDict({"action": action.expand(shape)}, batch_size=env.batch_size))["next"])
    return results


def same(a: TensorDictBase, b: TensorDictBase) -> bool:
    """Whether two tensordicts are equal to the last bit (inf equals inf)."""
    return all(torch.equal(a.get(key), b.get(key)) for key in a.keys(True, True))


@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
@pytest.mark.parametrize("driver", ["agent", "idm"])
@pytest.mark.parametrize("backend", ["batched", "reference"])
def test_specs_hold(backend: Backend, driver: Driver, action_type: ActionType) -> None:
    check_env_specs(make(MIXED, backend=backend, driver=driver, action_type=action_type, vehicles=5))


def test_outputs_match_the_contract() -> None:
    env = make(MIXED)
    state = env.rand_step(env.reset())["next"]
    assert state["observation"].shape == (3, 10, 5)
    assert state["observation"].dtype == torch.float32
    for key in ("reward", ("info", "progress"), ("info", "speed"), ("info", "x"), ("info", "ttc")):
        assert state[key].shape == (3, 1)
        assert state[key].dtype == torch.float32
    for key in ("done", "terminated", "truncated", ("info", "crashed"), ("info", "offroad")):
        assert state[key].shape == (3, 1)
        assert state[key].dtype == torch.bool
    assert env.action_spec.shape == (3,)
    assert make(MIXED, action_type="continuous").action_spec.shape == (3, 2)


@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
@pytest.mark.parametrize("driver", ["agent", "idm"])
def test_both_backends_give_the_same_tensors(action_type: ActionType, driver: Driver) -> None:
    ours, theirs = (
        make(MIXED, backend=b, action_type=action_type, driver=driver, action_repeat=2, vehicles=12)
        for b in ("batched", "reference")
    )
    torch.manual_seed(0)
    actions = torch.stack([ours.action_spec.rand() for _ in range(6)])
    first, second = start(ours, 4, 5, 6), start(theirs, 4, 5, 6)
    assert same(first.exclude("seed"), second.exclude("seed"))
    for a, b in zip(drive(ours, first, actions), drive(theirs, second, actions), strict=True):
        # numpy's AVX-512 kernels, where there are any, differ from scalar code in the last bit.
        for key in a.keys(True, True):
            torch.testing.assert_close(a.get(key), b.get(key), rtol=1e-5, atol=1e-5)


def test_the_same_seed_gives_the_same_episode_in_any_batch() -> None:
    alone, together = make((MIXED[1],)), make(MIXED)
    actions = torch.randint(0, 5, (40,), generator=torch.Generator().manual_seed(0))
    one = drive(alone, start(alone, 77), actions)
    many = drive(together, start(together, 5, 77, 6), actions)
    assert all(same(a, b[1:2]) for a, b in zip(one, many, strict=True))


def test_a_mixed_batch_equals_separate_batches() -> None:
    together = make(MIXED)
    actions = torch.randint(0, 5, (30, 3), generator=torch.Generator().manual_seed(1))
    many = drive(together, start(together, 1, 2, 3), actions)
    for row, cell in enumerate(MIXED):
        alone = make((cell,))
        one = drive(alone, start(alone, row + 1), actions[:, row : row + 1])
        assert all(same(a, b[row : row + 1]) for a, b in zip(one, many, strict=True))


def test_a_partial_reset_leaves_the_other_episodes_alone() -> None:
    env = make((CLEAR,) * 4)
    state = drive(env, start(env, 1, 2, 3, 4), torch.full((10,), SLOWER))[-1]
    mask = torch.tensor([[True], [False], [True], [False]])
    seeds = torch.tensor([1, 9, 8, 9])
    after = env.reset(state.clone().update({"_reset": mask, "seed": seeds}))
    fresh = start(make((CLEAR,) * 4), 1, 2, 8, 4)
    for key in ("observation", ("info", "x"), ("info", "speed")):
        assert torch.equal(after[key][[0, 2]], fresh[key][[0, 2]])
        assert torch.equal(after[key][[1, 3]], state[key][[1, 3]])
    assert env.engine.episodes["steps"].tolist() == [0, 10, 0, 10]


def test_a_finished_episode_does_not_change_and_has_no_reward() -> None:
    env = make((CLEAR,) * 2, max_steps=5)
    results = drive(env, start(env, 1, 2), torch.full((7,), IDLE))
    assert [bool(result["truncated"].all()) for result in results] == [False] * 4 + [True] * 3
    for late in results[5:]:
        assert late["done"].all()
        assert not late["reward"].any()
        assert not late["info", "progress"].any()
        assert torch.equal(late["observation"], results[4]["observation"])


def test_a_rollout_until_all_are_done_keeps_every_episode_whole() -> None:
    env = make((CLEAR,) * 3, max_steps=60)
    states = env.rollout(100, policy=lambda td: td.set("action", torch.full((3,), FASTER)), break_when_all_done=True)
    done = states["next", "done"].squeeze(-1)
    assert done[:, -1].all()
    assert states.shape[1] <= 60


def test_paused_episodes_do_not_move() -> None:
    env = make((CLEAR,) * 2)
    state = start(env, 1, 2)
    paused = TensorDict({"action": torch.full((2,), IDLE), "_step": torch.tensor([True, False])}, batch_size=[2])
    after = env.step(paused)["next"]
    assert after["info", "x"][0] > state["info", "x"][0]
    assert after["info", "x"][1] == state["info", "x"][1]


def test_drawn_scenarios_follow_from_set_seed_and_are_training_scenarios() -> None:
    seeds = []
    for seed in (0, 0, 1):
        env = make((CLEAR,) * 3)
        env.set_seed(seed)
        env.reset()
        first = env.engine.episodes["seed"].tolist()
        env.reset(TensorDict({"_reset": torch.tensor([[False], [True], [False]])}, batch_size=[3]))
        seeds.append(first + env.engine.episodes["seed"].tolist())
    assert seeds[0] == seeds[1] != seeds[2]
    assert len(set(seeds[0] + seeds[2])) == 8
    assert min(seeds[0]) >= SeedBlock.TRAIN
    assert seeds[0][3] == seeds[0][0]


def test_a_rollout_that_restarts_does_not_repeat_the_scenario_it_was_given() -> None:
    env = make(max_steps=3)
    state = start(env, 123)
    for _ in range(3):
        _, state = env.step_and_maybe_reset(state.set("action", torch.tensor([IDLE])))
    assert env.engine.episodes["steps"][0] == 0
    assert env.engine.episodes["seed"][0] != 123


def test_a_held_action_is_repeated_but_a_lane_change_is_sent_once() -> None:
    for action, rest in ((FASTER, FASTER), (SLOWER, SLOWER), (LANE_RIGHT, IDLE), (IDLE, IDLE)):
        held, single = make(action_repeat=3), make()
        [result] = drive(held, start(held, 3), torch.tensor([action]))
        frames = drive(single, start(single, 3), torch.tensor([action, rest, rest]))
        assert torch.equal(result["observation"], frames[-1]["observation"])
        total = sum(frame["reward"].double() for frame in frames)
        torch.testing.assert_close(result["reward"].double(), total)
        torch.testing.assert_close(result["info", "progress"], sum(f["info", "progress"] for f in frames))


def test_a_held_action_stops_at_the_step_limit() -> None:
    env = make(action_repeat=4, max_steps=6)
    results = drive(env, start(env, 3), torch.full((2,), IDLE))
    assert results[-1]["truncated"].all()
    assert env.engine.episodes["steps"][0] == 6


def test_leaving_the_road_ends_the_episode_unless_told_otherwise() -> None:
    swerve = torch.tensor([[0.0, 0.7]]).expand(40, 1, 2)
    for ends in (True, False):
        env = make(action_type="continuous", offroad_terminal=ends)
        last = drive(env, start(env, 1), swerve)[-1]
        assert last["info", "offroad"].all()
        assert bool(last["terminated"]) is ends


def test_progress_is_zero_after_a_crash_and_full_at_full_speed_on_the_right() -> None:
    env = make((CLEAR,) * 8)
    results = drive(env, start(env, *range(8)), torch.full((300,), FASTER))
    crashed = results[-1]["info", "crashed"]
    assert crashed.any()
    at_crash = [r["info", "progress"][r["info", "crashed"]] for r in results]
    assert not torch.cat(at_crash).any()
    progress = torch.stack([r["info", "progress"] for r in results])
    assert ((progress >= 0) & (progress <= 1)).all()


def test_a_reset_names_an_invalid_seed() -> None:
    for backend in ("batched", "reference"):
        with pytest.raises(ValueError, match="at least 0, got -1"):
            start(make(backend=backend), -1)


def test_an_unknown_action_is_refused() -> None:
    env = make()
    with pytest.raises(ValueError, match="between 0 and 4"):
        drive(env, start(env, 1), torch.tensor([5]))


@settings(max_examples=10, deadline=None)
@given(st.lists(st.sampled_from(MIXED), min_size=1, max_size=5), st.integers(0, 2**40))
def test_observations_stay_in_range_and_rows_are_compact(cells: list[Cell], seed: int) -> None:
    env = make(cells)
    env.set_seed(seed)
    observation = env.rollout(8)["next", "observation"]
    present = observation[..., 0]
    assert observation.abs().max() <= 1
    assert set(present.unique().tolist()) <= {0.0, 1.0}
    assert (present[..., 0] == 1).all()
    assert (present.diff(dim=-1) <= 0).all()
    assert not observation[present == 0].any()


def test_the_reference_does_not_depend_on_what_else_the_process_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Making an intersection of highway-env rewrites constants of the class of all IDM drivers."""
    for name in ("DISTANCE_WANTED", "COMFORT_ACC_MAX", "COMFORT_ACC_MIN"):
        monkeypatch.setattr(IDMVehicle, name, getattr(IDMVehicle, name))  # Restored after the test.
    gymnasium.make("intersection-v0").reset(seed=0)
    assert IDMVehicle.DISTANCE_WANTED == 7
    monkeypatch.setattr(Vehicle, "MAX_SPEED", 20.0)
    ours, theirs = (make(backend=backend, driver="idm", vehicles=20) for backend in ("batched", "reference"))
    states = [start(env, 5) for env in (ours, theirs)]
    for a, b in zip(
        *(drive(env, at, torch.ones(60, 1)) for env, at in zip((ours, theirs), states, strict=True)), strict=True
    ):
        for key in a.keys(True, True):
            torch.testing.assert_close(a.get(key), b.get(key), rtol=1e-5, atol=1e-5)
    assert (IDMVehicle.DISTANCE_WANTED, IDMVehicle.MAX_SPEED) == (7, 20.0), "others of the process keep theirs"
    assert "MAX_SPEED" not in vars(IDMVehicle)


def test_a_sum_over_a_rollout_counts_each_episode_to_its_end() -> None:
    """The example of docs/worlds/highway.md."""
    code = next(
        block for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL) if "rollout" in block
    )
    found: dict[str, Any] = {}
    torch.manual_seed(0)
    exec(code, found)
    rewards, returns = found["episodes"]["next", "reward"].squeeze(-1), found["returns"]
    lengths = found["episodes"]["next", "done"].squeeze(-1).int().argmax(1) + 1
    assert len(set(lengths.tolist())) > 1
    for row, length, total in zip(rewards, lengths, returns, strict=True):
        assert total == pytest.approx(float(row[:length].sum()), rel=1e-6)


@pytest.mark.parametrize("preset", ["standard", "wide", "thesis"])
def test_every_lane_is_within_the_observation(preset: Any) -> None:
    """On more lanes than the range of y holds, a car would not see the edge of the road: such roads are refused."""
    world = HighwayWorld(preset=preset)
    for lanes in range(2, 9):
        cell = AXES.cell(lanes=lanes, density=1.0)
        edge = 4 * (lanes - 1) + 2
        if edge <= world.features.high[1]:
            assert world.make([cell]).batch_size == (1,)
            assert not world.doubts([cell])
            continue
        for ask in (world.make, world.doubts):
            with pytest.raises(
                UserError, match=f"on {lanes} lanes y reaches {edge} m, .* at most 5 lanes, or .*preset=wide"
            ):
                ask([CLEAR, cell])
    assert lanes == 8


def test_dense_traffic_is_doubted() -> None:
    assert not HighwayWorld().doubts([AXES.cell(lanes=3, density=2.0)])
    (line,) = HighwayWorld().doubts([AXES.cell(lanes=3, density=2.0), AXES.cell(lanes=3, density=3.0)])
    assert line.startswith("density 3 makes crashes without any attack")
