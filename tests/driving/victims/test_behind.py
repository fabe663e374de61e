"""A driver that learns behind a defence."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from cavbench import zoo
from cavbench.core import registry
from cavbench.driving import DrivingWorld
from cavbench.driving.intervals.ego import fields
from cavbench.driving.victims.attack_mix import AttackMix
from cavbench.driving.victims.behind import Guard, GuardedPractice, defense_of
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.practice import ALLOWED, roads
from cavbench.driving.victims.training import LearningDriver
from tests.driving.victims.learners import LEARNERS, NAMES


@pytest.fixture
def world() -> DrivingWorld:
    return registry.load("world", "highway")()


@pytest.mark.parametrize("victim", [*LEARNERS], ids=NAMES)
def test_a_policy_behind_a_filter_learns_from_what_passes_it(victim: LearningDriver, world: DrivingWorld) -> None:
    """Stored actions are allowed (or clipped when they are carried out), and a new episode begins with a fresh state."""
    recipe = replace(victim, behind="tracker+shield")
    policy = recipe.policy_type(**_shape(recipe))
    hooks = AttackMix(policy, 40, world.facts, seed=0)
    env = world.make(roads(world, 4), action_type=recipe.action_type)
    env.set_seed(0)
    learner = recipe.learner(env, hooks)
    phase = recipe.phases(hooks)[0]
    learner.enter(phase)
    guard = Guard(defense_of(recipe.behind), recipe, world.facts)
    practice = GuardedPractice(env, learner, phase, crash_penalty=40.0, guard=guard)
    executed = []
    for _ in range(40):
        before = practice.seen
        with torch.no_grad():
            step = practice.decide(0.0)
        assert torch.equal(step["observation"], before["observation"])
        action, allowed = step["action"], step[ALLOWED]
        if recipe.action_type == "discrete":
            assert bool(allowed.gather(1, action.unsqueeze(1)).all())
        else:
            executed.append((action.clamp(allowed[:, 0], allowed[:, 1]) - action).abs().max())
        restarted = step["next", "done"].squeeze(-1)
        assert practice.state is not None
        assert torch.equal(fields(practice.state["ego"])[1], ~restarted)
    assert recipe.action_type == "discrete" or max(executed) > 0.1


def test_another_defence_is_part_of_the_recipe() -> None:
    plain, behind, other = DQN(), DQN(behind="shield"), DQN(behind="shield band=6")
    keys = {zoo.Recipe.of(victim).key for victim in (plain, behind, other)}
    assert len(keys) == 3
    assert behind.zoo_name() == "dqn-behind-shield"


def _shape(victim: LearningDriver) -> dict[str, object]:
    shape: dict[str, object] = {"features": 5, "hidden": 8}
    return shape | ({"actions": 5} if victim.action_type == "discrete" else {"steering_limit": 0.1})
