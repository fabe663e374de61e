"""Real policies with a state, and their state after some steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cavbench.defenses.driving.frame_stack import FrameStack, Reduction
from cavbench.defenses.driving.recurrent import RecurrentPolicy
from cavbench.driving import ActionType, DrivingFacts, DrivingVictim, Policy, State
from cavbench.driving.victims.reference import Blind, RandomDriver
from cavbench.envs.highway.world import HighwayWorld
from tests.attacks.driving.victims import observations, victim

FACTS = HighwayWorld().facts


class Echo(Policy):
    """Its scores are its observation, so that a test can read the output of a defence."""

    action_type = "discrete"

    def forward(self, observation: Tensor) -> Tensor:
        return observation.flatten(-2)


@dataclass(frozen=True, kw_only=True)
class Given(DrivingVictim):
    """A victim that returns a given policy."""

    policy: Policy

    @property
    def action_type(self) -> ActionType:
        return self.policy.action_type

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return self.policy


def stacked(inner: Policy, frames: int = 3, reduce: Reduction = "mean") -> Policy:
    """A policy with a frame stack."""
    return FrameStack(frames=frames, reduce=reduce).load(Given(policy=inner), 0, FACTS)


def recurrent() -> RecurrentPolicy:
    """A policy with a GRU of random weights that are large enough to matter."""
    torch.manual_seed(0)
    policy = RecurrentPolicy(5, 5, 16, 8)
    with torch.no_grad():
        for weight in policy.parameters():
            weight.mul_(2.0)
    return policy.requires_grad_(False).eval()


STATEFUL: dict[str, Callable[[], Policy]] = {
    "stacked dqn": lambda: stacked(victim("discrete")),
    "stacked ddpg": lambda: stacked(victim("continuous"), 4, "median"),
    "stack of stacks": lambda: stacked(stacked(victim("discrete"), 2), 3, "median"),
    "sequence": lambda: Blind().load(0, FACTS),
    "stacked sequence": lambda: stacked(Blind().load(0, FACTS)),
    "recurrent": recurrent,
    "stacked recurrent": lambda: stacked(recurrent()),
    "stacked random": lambda: stacked(RandomDriver().load(0, FACTS)),
}


def remembered(policy: Policy, episodes: int, steps: int, seed: int = 0) -> TensorDictBase:
    """The state [episodes] after some steps; of a policy that counts steps, episodes are at different places."""
    state: State = policy.initial(torch.arange(episodes))
    with torch.no_grad():
        for step in range(steps):
            observation = observations(episodes, 1000 * seed + step)
            state = policy.advance(observation, policy.decide(observation, state), state)
    assert state is not None
    for key in state.keys(include_nested=True, leaves_only=True):
        if (key[-1] if isinstance(key, tuple) else key) == "step":
            state[key] = state[key] + 17 * torch.arange(episodes)
    return state
