"""SAC of discrete actions: its temperature, its target entropy and its soft values."""

from __future__ import annotations

import math
from unittest.mock import patch

import pytest
import torch

from cavbench.core import registry
from cavbench.driving import DrivingWorld, TrainingHooks
from cavbench.driving.victims.attack_mix import AttackMix
from cavbench.driving.victims.learner import CHUNK
from cavbench.driving.victims.logits import SoftPolicy
from cavbench.driving.victims.practice import ALLOWED, roads
from cavbench.driving.victims.sac import SAC
from tests.driving.victims.learners import REPLAYED, Lesson


@pytest.fixture
def world() -> DrivingWorld:
    return registry.load("world", "highway")()


def soft_lesson(**params: object) -> tuple[SAC, Lesson]:
    """A SAC and transitions [64] of single decisions: `action` 2 earns 1, the others 0."""
    victim = SAC(**REPLAYED | params)
    lesson = Lesson(victim, registry.load("world", "highway")())
    sample = lesson.sample
    sample["steps_to_next_obs"] = torch.ones(64, 1, dtype=torch.int64)
    sample["next", "reward"] = (sample["action"] == 2).float().unsqueeze(-1)
    sample["next", "terminated"] = sample["next", "done"] = torch.ones(64, 1, dtype=torch.bool)
    return victim, lesson


@pytest.mark.parametrize("target", [0.9, 0.2])
def test_the_temperature_keeps_the_target_entropy(target: float) -> None:
    victim, lesson = soft_lesson(final_entropy=target, entropy=target, temperature=1.0, temperature_rate=0.02)
    learner = victim.learner(lesson.env, TrainingHooks())
    learner.enter(victim.phases(TrainingHooks())[0])
    for _ in range(400):
        learner.update(lesson.sample.clone(), 3e-3)
    policy = torch.distributions.Categorical(logits=learner.policy.scores(lesson.shown))
    assert float(policy.entropy().mean()) / math.log(5) == pytest.approx(target, abs=0.1)
    assert bool((policy.probs.argmax(-1) == 2).all())


def test_the_target_entropy_falls_to_its_end() -> None:
    victim, lesson = soft_lesson(entropy=0.8, final_entropy=0.1, explore_until=0.5)
    learner = victim.learner(lesson.env, TrainingHooks())
    learner.enter(victim.phases(TrainingHooks())[0])
    shares = []
    for _ in range(victim.decisions // CHUNK):
        learner.anneal()
        shares.append(learner.rule.entropy / math.log(5))
    assert shares[4] == pytest.approx(0.8 * (0.1 / 0.8) ** 0.5, rel=1e-4)
    assert shares[9:] == pytest.approx([0.1] * 11, rel=1e-4)


def test_actions_that_are_not_allowed_have_no_part_in_the_soft_values() -> None:
    """The value of the next state is that of the only action that is left."""
    victim, lesson = soft_lesson(behind="tracker+shield", temperature=1.0)
    with patch.object(TrainingHooks, "learns_otherwise", True):
        learner = victim.learner(lesson.env, TrainingHooks())
    learner.enter(victim.phases(TrainingHooks())[0])
    sample, only = lesson.sample.clone(), torch.nn.functional.one_hot(torch.arange(64) % 5, 5).bool()
    sample["next", "terminated"] = sample["next", "done"] = torch.zeros(64, 1, dtype=torch.bool)
    sample["next", ALLOWED] = only
    target = learner.rule.loss._compute_target(sample)
    values = learner.policy.values(sample["next", "observation"])[only]
    torch.testing.assert_close(target, sample["next", "reward"].squeeze(-1) + victim.gamma * values)


def test_a_soft_policy_continues_with_its_critics(world: DrivingWorld) -> None:
    start = SoftPolicy(5, 5, 8)
    hooks = AttackMix(start, 40, world.facts, seed=0)
    learner = SAC(**REPLAYED).learner(world.make(roads(world, 1), action_type="discrete"), hooks)
    learner.anneal()
    for network in (learner.policy, learner.averaged()):
        assert all(torch.equal(value, start.state_dict()[name]) for name, value in network.state_dict().items())
