"""PPO: in its second phase the critic learns first, and a crash costs more."""

from __future__ import annotations

import pytest
from tensordict import TensorDict

from cavbench.core import registry
from cavbench.driving import DrivingWorld, TrainingHooks
from cavbench.driving.victims.learner import CHUNK
from cavbench.driving.victims.ppo import PPO
from cavbench.driving.victims.practice import Practice, roads
from tests.driving.victims.learners import SHORT


@pytest.fixture
def world() -> DrivingWorld:
    return registry.load("world", "highway")()


def test_in_the_second_phase_of_ppo_the_critic_learns_first_and_a_crash_costs_more(world: DrivingWorld) -> None:
    victim = PPO(**SHORT, fine_rollout=CHUNK, fine_batch=16, settling=2, tau=1.0)
    phase = victim.phases(TrainingHooks())[1]
    env = world.make(roads(world, 1), action_type="discrete")
    env.set_seed(0)
    learner = victim.learner(env, TrainingHooks())
    learner.enter(phase)
    assert learner.progress(TensorDict({"progress": 1.0, "crashed": True, "offroad": False})) == 1 - 360
    practice = Practice(env, learner, phase, crash_penalty=40.0)
    moved = []
    for _ in range(3):
        before = [[weight.clone() for weight in part.parameters()] for part in (learner.policy, learner.critic)]
        practice.drive(CHUNK, 0.5)
        learner.learn(1e-3, 0.5)
        after = [list(part.parameters()) for part in (learner.policy, learner.critic)]
        moved.append(
            [any((a != b).any() for a, b in zip(*pair, strict=True)) for pair in zip(before, after, strict=True)]
        )
    assert moved == [[False, True], [False, True], [True, True]]
