"""A victim at the wheel: observations to scores, scores to an action, and what it remembers from one step to the next."""

from __future__ import annotations

from abc import ABC
from typing import TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from bench.driving.features import ActionType, Driver

State: TypeAlias = TensorDictBase | None
"""What is remembered of B episodes, a TensorDict of batch size [B]; None where nothing is."""


class Policy(nn.Module, ABC):
    """A victim at the wheel: a differentiable map from observations to scores, and from scores to an action.

    One without a memory writes `forward` and nothing else, as any torch network does. One that remembers writes `initial`,
    `scores` and `advance`: the run keeps its state, and asking for scores changes nothing, however often and for whichever
    episodes an attack asks.
    """

    action_type: ActionType
    driver: Driver = "agent"
    weights_sha256: str = ""
    """Hash of the weights file it was loaded from; empty where there is none."""

    def forward(self, observation: Tensor) -> Tensor:
        """The scores of a policy without a memory (see `scores`).

        Args:
            observation: float [..., V, F].
        """
        raise NotImplementedError(f"{type(self).__name__} has neither forward nor scores")

    def initial(self, episodes: Tensor) -> State:
        """What is remembered before the first step.

        Args:
            episodes: int64 [B], a number that identifies each episode; a policy that draws seeds its generators with it.
        """
        return None

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        """What a score-based attacker reads: Q-values [..., A] (discrete) or the action itself [..., 2] (continuous).

        A pure function: the same observation and state give the same scores.

        Args:
            observation: float [..., V, F].
            state: of the same episodes, of batch size [...]; None for a policy without a memory.
        """
        return self(observation)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        """What is remembered after a step.

        Args:
            observation: what was shown, [B, V, F].
            action: what was done, int64 [B] or float [B, 2].
            state: before the step.
        """
        return state

    def choose(self, scores: Tensor) -> Tensor:
        """The action that goes with scores: int64 [...] (discrete, the greedy one) or float [..., 2] in [-1, 1] (continuous)."""
        return scores.argmax(-1) if self.action_type == "discrete" else scores

    def decide(self, observation: Tensor, state: State = None) -> Tensor:
        """The action for an observation, as in `choose`; arguments as in `scores`."""
        return self.choose(self.scores(observation, state))

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        """Q(observation, action) [...], differentiable in both; for white-box attacks on continuous actions.

        Raises:
            NotImplementedError: if the victim has no critic.
        """
        raise NotImplementedError(f"{type(self).__name__} has no critic")


class PolicyWrapper(Policy):
    """A policy in front of another one, as defences are: everything passes through but what is overridden.

    Args:
        policy: the other one, `self.policy`. What it remembers is the state, unless `initial` and `advance` are overridden.
    """

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy = policy
        self.action_type, self.driver, self.weights_sha256 = policy.action_type, policy.driver, policy.weights_sha256

    def initial(self, episodes: Tensor) -> State:
        return self.policy.initial(episodes)

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        return self.policy.scores(observation, state)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        return self.policy.advance(observation, action, state)

    def choose(self, scores: Tensor) -> Tensor:
        return self.policy.choose(scores)

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        return self.policy.value(observation, action, state)


def rows_of(state: State, rows: Tensor) -> State:
    """The state of some episodes, int64 [R] or bool [B]."""
    return None if state is None else state[rows]


def repeated(state: State, leading: torch.Size) -> State:
    """The state of [B] episodes, repeated for observations `[*leading, B, V, F]` and flattened to [N]."""
    return None if state is None else state.expand(*leading, *state.batch_size).reshape(leading.numel() * len(state))
