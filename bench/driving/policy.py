"""Driving policies: a map from observations to scores and from scores to actions, with an optional state per episode."""

from __future__ import annotations

from abc import ABC
from typing import NamedTuple, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from cavbench.driving.features import ActionType, Driver

State: TypeAlias = TensorDictBase | None
"""The state of B episodes: a TensorDict of batch size [B]; None for stateless policies and attacks."""


class Passed(NamedTuple):
    """What a defence passes on to the policy behind it.

    Args:
        observation: the observation that the policy receives, [..., V, F].
        allowed: the actions that are left to it: bool [..., A] for discrete ones, float [..., 2, 2] for continuous ones (the
            lowest values of both controls, then the highest); None for all.
    """

    observation: Tensor
    allowed: Tensor | None = None


class Suspicion(NamedTuple):
    """What a policy says about being attacked.

    Args:
        level: how strongly it doubts what it was shown, [B]; the higher, the more.
        alarm: whether that is enough for an alarm, bool [B].
    """

    level: Tensor
    alarm: Tensor


class Policy(nn.Module, ABC):
    """A driving policy: a differentiable map from observations to scores, and from scores to an action.

    A stateless policy implements only `forward`, like any torch network. A policy with a state implements `initial`, `scores`
    and `advance`. The run keeps the state; `scores` does not change it, so an attack may query any episodes any number of times.
    """

    action_type: ActionType
    driver: Driver = "agent"
    weights_sha256: str = ""
    """Hash of the policy's weights file; empty if there is none."""
    noise: float = 0.0
    """Standard deviation of independent Gaussian noise that it adds to every measured value of each observation, before anything
    else sees it; 0 if it does not. The certificate of its score follows from it (`cavbench.statistics.certificate`)."""

    def forward(self, observation: Tensor) -> Tensor:
        """The scores of a stateless policy (see `scores`).

        Args:
            observation: float [..., V, F].
        """
        raise NotImplementedError(f"{type(self).__name__} implements neither forward nor scores")

    def initial(self, episodes: Tensor) -> State:
        """The state before the first step.

        Args:
            episodes: int64 [B], an opaque number for each episode (not its scenario seed), the same whenever the episode is
                driven; a randomised policy seeds its generators with it.
        """
        return None

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        """The output that score-based attacks read: Q-values [..., A] (discrete) or the action itself [..., 2] (continuous).

        A pure function: the same observation and state give the same scores.

        Args:
            observation: float [..., V, F].
            state: the state of the same episodes, batch size [...]; None for a stateless policy.
        """
        return self(observation)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        """The state after a step.

        Args:
            observation: the observation that the policy received, [B, V, F].
            action: the action taken, int64 [B] or float [B, 2].
            state: the state before the step.
        """
        return state

    def assured(self, observation: Tensor, state: State) -> Tensor | None:
        """Whether an action is safe under what the policy assumes, bool [B]; None if it promises nothing.

        Records show the share of such frames (`assured`). Arguments as in `advance`.
        """
        return None

    def suspicion(self, observation: Tensor, state: State) -> Suspicion | None:
        """Whether it takes what it was shown for falsified; None if it does not watch. Arguments as in `advance`."""
        return None

    def passed(self, observation: Tensor, state: State = None) -> Passed:
        """What reaches the innermost policy, and what is left to it; arguments as in `scores`.

        A policy is trained behind a defence by this alone.
        """
        return Passed(observation)

    def choose(self, scores: Tensor) -> Tensor:
        """The action for given scores: the greedy one, int64 [...] (discrete), or float [..., 2] in [-1, 1] (continuous)."""
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
    """A policy that wraps another one, for defences: every method that is not overridden calls the wrapped policy.

    Args:
        policy: the wrapped policy, `self.policy`. Its state is the state, unless `initial` and `advance` are overridden.
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

    def passed(self, observation: Tensor, state: State = None) -> Passed:
        raise NotImplementedError(f"{type(self).__name__} does not say what it passes on")

    def choose(self, scores: Tensor) -> Tensor:
        return self.policy.choose(scores)

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        return self.policy.value(observation, action, state)


def rows_of(state: State, rows: Tensor) -> State:
    """The state of the episodes `rows`, int64 [R] or bool [B]."""
    return None if state is None else state[rows]


def repeated(state: State, leading: torch.Size) -> State:
    """The state of [B] episodes, repeated for observations `[*leading, B, V, F]` and flattened to [N]."""
    return None if state is None else state.expand(*leading, *state.batch_size).reshape(leading.numel() * len(state))
