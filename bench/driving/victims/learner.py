"""The base class of a learning algorithm: networks, loss and optimiser. The trained drivers implement it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from cavbench.driving import Policy, TrainingHooks

CHUNK = 8
"""Decisions taken between two rounds of gradient updates."""


@dataclass(frozen=True)
class Phase:
    """A phase of the training in which each decision is held for `repeat` frames.

    Args:
        repeat: number of frames for which a decision is held.
        decisions: number of decisions on every road in this phase.
        gamma: discount per decision.
        n_step: number of decisions in a return, for learners with a replay buffer.
        exploration: multiplies the recipe's final exploration, so that the rate of random actions per second does not change.
        gap: gap of advantage learning, in [0, 1); it widens the action gap by 1 / (1 - gap).
    """

    repeat: int
    decisions: int
    gamma: float
    n_step: int = 1
    exploration: float = 1.0
    gap: float = 0.0


class Learner(ABC):
    """One algorithm: networks, loss, optimiser.

    Args:
        hooks: the changes of a defence; the policy continues from `hooks.start` if it is set.
    """

    policy: Policy
    """The network in training."""
    explore: nn.Module
    """Reads `observation` [B, V, F] from a tensordict and writes `action`, with exploration."""

    def __init__(self, hooks: TrainingHooks) -> None:
        self.hooks = hooks

    @abstractmethod
    def enter(self, phase: Phase) -> None:
        """Set the discount and exploration of a phase, and forget the transitions of the one before."""

    def progress(self, info: TensorDictBase) -> Tensor:
        """The reward [B, 1] of a decision without a failure, summed over its frames, from the environment's `info`."""
        progress: Tensor = info["progress"]
        return progress

    @abstractmethod
    def collect(self, chunk: TensorDictBase) -> None:
        """Take a chunk of transitions [B, T]."""

    @abstractmethod
    def learn(self, learning_rate: float, share: float) -> None:
        """Learn from what was collected; `share` of the training is finished."""

    @abstractmethod
    def update(self, sample: TensorDictBase, learning_rate: float) -> None:
        """One gradient step on a batch of transitions; `hooks.loss` may change the algorithm's loss."""

    @abstractmethod
    def anneal(self) -> None:
        """Reduce the exploration after a chunk of decisions."""

    @abstractmethod
    def averaged(self) -> Policy:
        """The policy with the Polyak-averaged weights of the target networks."""


def copy_weights(params: TensorDictBase, module: nn.Module) -> None:
    """Copy the parameters of a TorchRL loss into a module of the same structure.

    Args:
        params: for instance `loss.target_value_network_params`, or one item of the stacked `loss.qvalue_network_params`.
        module: a TensorDictModule with the structure of the module given to the loss.
    """
    TensorDict.from_module(module).data.update_(params.data)
