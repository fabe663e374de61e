"""Short real trainings: their data, hooks, and reproducibility by seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from cavbench.core import registry
from cavbench.driving import DrivingWorld, Policy, State, TrainingHooks
from cavbench.driving.victims.ddpg import DDPG
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.ppo import PPO
from cavbench.driving.victims.practice import Practice, roads
from cavbench.driving.victims.sac import SAC
from cavbench.driving.victims.training import LearningDriver
from tests.driving.victims.learners import LEARNERS, NAMES, REPLAYED, VICTIMS, silent


@pytest.fixture
def world() -> DrivingWorld:
    return registry.load("world", "highway")()


@pytest.mark.parametrize("victim", LEARNERS, ids=NAMES)
def test_a_training_depends_on_its_seed_only(victim: LearningDriver, world: DrivingWorld) -> None:
    first, again, other = (victim.train(world, seed=seed, progress=silent).network.state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


def test_the_card_has_the_checkpoint_selection(world: DrivingWorld) -> None:
    card = VICTIMS[0].train(world, seed=0, progress=silent).card
    assert set(card["selection"]["safe_progress"]["clean"]) == {
        "mean",
        *(f"lanes {n}, density {d}, clear" for n in (3, 4, 5) for d in (1, 2)),
    }


def test_only_a_driver_that_learns_from_a_replay_buffer_has_its_parameters() -> None:
    of_the_buffer = {"n_step", "memory", "updates"}
    assert all(of_the_buffer <= {field.name for field in fields(victim)} for victim in (DQN, DDPG, SAC))
    assert not of_the_buffer & {field.name for field in fields(PPO)}


def test_returns_end_where_the_episode_ends(world: DrivingWorld) -> None:
    victim = DQN(**REPLAYED | {"copies": 4, "crash_penalty": 1000.0})
    phase = victim.phases(TrainingHooks())[0]
    env = world.make(roads(world, 4), action_type="discrete", action_repeat=phase.repeat)
    env.set_seed(0)
    learner = victim.learner(env, TrainingHooks())
    learner.enter(phase)
    practice = Practice(env, learner, phase, crash_penalty=1000.0)
    practice.drive(120, 0.0)
    seen = learner.buffer[:]
    short = seen["steps_to_next_obs"].squeeze(-1) < phase.n_step
    over = seen["next", "done"].squeeze(-1)
    crashed = seen["next", "terminated"].squeeze(-1)
    assert crashed.any()
    assert bool((over | ~short).all())
    assert bool((seen["next", "reward"].squeeze(-1)[crashed] < -1).all())
    assert bool((seen["next", "reward"].squeeze(-1)[~crashed] >= 0).all())


class Calm(TrainingHooks):
    """Another defence: it prefers small scores, scales replayed observations, and logs its calls."""

    def __init__(self) -> None:
        self.asked: set[str] = set()

    def replayed(self, observation: Tensor, policy: Policy, share: float) -> Tensor:
        self.asked.add("replayed")
        return 0.9 * observation

    def loss(self, policy: Policy, sample: TensorDictBase, own: Callable[[TensorDictBase], Tensor]) -> Tensor:
        torch.testing.assert_close(sample["observation"], 0.9 * sample["truth"])
        return own(sample) + 100 * policy.scores(sample["truth"]).square().mean()

    def selection(self, policy: Policy) -> dict[str, Callable[[Tensor, State], Tensor]]:
        return {"darker": lambda observation, state: 0.9 * observation}


@pytest.mark.parametrize("victim", VICTIMS, ids=["dqn", "ddpg"])
def test_any_defence_adds_its_own_loss_through_the_hooks(victim: LearningDriver, world: DrivingWorld) -> None:
    hooks, x = Calm(), torch.rand(64, 10, 5)
    plain = victim.train(world, seed=0, progress=silent).network.scores(x)
    calm = victim.train(world, seed=0, hooks=hooks, progress=silent)
    assert hooks.asked == {"replayed"}
    assert set(calm.card["selection"]["safe_progress"]) == {"clean", "darker"}
    assert float(calm.network.scores(x).square().mean()) < float(plain.square().mean())


@pytest.mark.parametrize("victim", VICTIMS, ids=["dqn", "ddpg"])
def test_default_hooks_do_not_change_the_training(victim: LearningDriver, world: DrivingWorld) -> None:
    plain, hooked = (
        victim.train(world, seed=0, hooks=hooks, progress=silent).network.state_dict()
        for hooks in (None, TrainingHooks())
    )
    assert all(torch.equal(plain[name], hooked[name]) for name in plain)
