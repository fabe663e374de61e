"""A recipe's learner in both ways: with compiled updates and with torch's."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from cavbench.core import registry
from cavbench.driving import TrainingHooks
from cavbench.driving.victims.practice import ALLOWED, Practice, roads
from cavbench.driving.victims.training import LearningDriver


def learner(recipe: LearningDriver, phase: int, *, compiled: bool, start: Any = None) -> tuple[Any, Any, Any]:
    """A learner that is in a phase, its environment and the phase."""
    world = registry.load("world", "highway")()
    hooks = TrainingHooks()
    hooks.start, hooks.decisions = start, 160
    torch.manual_seed(0)
    with patch.object(TrainingHooks, "learns_otherwise", not compiled):
        phases = recipe.phases(hooks)
        env = world.make(roads(world, 1), action_type="discrete", action_repeat=phases[phase].repeat)
        env.set_seed(0)
        found = recipe.learner(env, hooks)
    found.enter(phases[phase])
    return found, env, phases[phase]


def both(recipe: LearningDriver, phase: int) -> tuple[Any, Any, Any, Any]:
    """The compiled learner, torch's with the same weights, and the environment and the phase of the latter."""
    (compiled, _, _), (torchs, env, entered) = (learner(recipe, phase, compiled=each) for each in (True, False))
    return compiled, torchs, env, entered


def only(practice: Practice, allowed: Tensor) -> None:
    """What a defence would leave to a policy: everywhere the same actions."""
    everywhere = allowed.expand(len(practice.td), len(allowed))
    step = practice.env.step_and_maybe_reset
    practice.td[ALLOWED] = everywhere

    def left(tensordict: Any) -> Any:
        now, after = step(tensordict)
        now["next", ALLOWED] = after[ALLOWED] = everywhere
        return now, after

    practice.env.step_and_maybe_reset = left


def parameters_of(learner: Any) -> Iterator[Tensor]:
    """The weights of a policy and its critic."""
    yield from learner.policy.parameters()
    yield from learner.critic.parameters()
