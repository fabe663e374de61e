"""A learning algorithm: its networks, loss and optimiser. `dqn` and `ddpg` implement it, `training` drives it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from tensordict import TensorDict, TensorDictBase
from torch import nn

from bench.driving import Policy, TrainingHooks

CHUNK = 8
"""Decisions taken between two rounds of gradient updates."""


@dataclass(frozen=True)
class Phase:
    """A stretch of the training in which a decision is held for `repeat` frames.

    Args:
        repeat: frames a decision is held.
        decisions: taken on every road in this phase.
        gamma: discount a decision.
        n_step: decisions in a return.
        exploration: final exploration of the recipe is multiplied by this: random actions a second stay as rare.
        gap: of advantage learning, in [0, 1): gaps between the values of actions grow by 1 / (1 - gap).
    """

    repeat: int
    decisions: int
    gamma: float
    n_step: int
    exploration: float = 1.0
    gap: float = 0.0


class Learner(ABC):
    """One algorithm: networks, loss, optimiser.

    Args:
        hooks: what a defence changes in the training; the policy continues from `hooks.start` where there is one.
    """

    policy: Policy
    """The network that is trained."""
    explore: nn.Module
    """Takes a tensordict with `observation` [B, V, F], writes an exploring `action`."""

    def __init__(self, hooks: TrainingHooks) -> None:
        self.hooks = hooks

    @abstractmethod
    def enter(self, phase: Phase) -> None:
        """Take on the phase's discount and exploration."""

    @abstractmethod
    def update(self, sample: TensorDictBase, learning_rate: float) -> None:
        """One gradient step on a batch of transitions, with the loss that `hooks.loss` makes of the algorithm's own."""

    @abstractmethod
    def anneal(self) -> None:
        """Explore less: a chunk of decisions more has been taken."""

    @abstractmethod
    def averaged(self) -> Policy:
        """The policy with the Polyak-averaged weights of the target networks."""


def copy_weights(params: TensorDictBase, module: nn.Module) -> None:
    """Copy the parameters that a TorchRL loss holds into a module of the same structure as the one the loss was given.

    Args:
        params: for instance `loss.target_value_network_params`; one of `loss.qvalue_network_params`, which are stacked.
        module: a TensorDictModule of the same structure.
    """
    TensorDict.from_module(module).data.update_(params.data)
