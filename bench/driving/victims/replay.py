"""Learning from a replay buffer of n-step transitions: what DQN, DDPG and SAC have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import MultiStepTransform

from cavbench.core.ranges import Count, Share
from cavbench.driving import TrainingHooks
from cavbench.driving.fused.q_learning import Transitions
from cavbench.driving.victims.learner import CHUNK, Learner, Phase
from cavbench.driving.victims.training import LearningDriver


@dataclass(frozen=True, kw_only=True)
class OffPolicyDriver(LearningDriver):
    """The base class of trained drivers that learn from a replay buffer.

    Args:
        n_step: decisions in a return of the first phase; the second phase uses the same time span.
        memory: size of the replay buffer in transitions.
        updates: gradient updates per decision of the whole batch of roads.
        tau: rate of the target networks' soft update.
    """

    n_step: Count = 3
    memory: Count = 600_000
    updates: Count = 1
    tau: Share = 0.005

    def phases(self, hooks: TrainingHooks) -> list[Phase]:
        *coarse, fine = super().phases(hooks)
        # An n-step return assumes that the actions are the policy's own, so it is short if they are not (`off_policy`).
        span = self.repeat if hooks.off_policy else self.n_step * self.repeat
        return [*(replace(phase, n_step=self.n_step) for phase in coarse), replace(fine, n_step=span)]


class Compiled(ABC):
    """How a learner learns in compiled calls (`cavbench.driving.fused`).

    Args:
        mask: key of the actions that a defence leaves; None for all.
    """

    def __init__(self, mask: str | None) -> None:
        self.mask = mask

    def learn(self, stored: TensorDictBase, batch: int, updates: int, rate: float) -> None:
        """Make several updates on random batches of what is `stored`."""
        transitions = Transitions.of(stored, self.mask)
        for rows in torch.randint(len(transitions), (updates, batch)):
            self.descend(transitions[rows], rate)

    def update(self, sample: TensorDictBase, rate: float) -> None:
        self.descend(Transitions.of(sample, self.mask), rate)

    @abstractmethod
    def descend(self, batch: Transitions, rate: float) -> None:
        """One gradient step on a batch of transitions."""


class OffPolicyLearner(Learner):
    """An algorithm that learns from batches of a replay buffer, which is empty when a phase begins.

    Args:
        hooks: as of `Learner`.
        memory: size of the buffer in transitions.
        batch: transitions per update.
        updates: gradient updates per decision.
    """

    rule: Any = None
    """How it learns, if it has several ways. A `Compiled` one draws its batches itself."""

    def __init__(self, hooks: TrainingHooks, *, memory: int, batch: int, updates: int) -> None:
        super().__init__(hooks)
        self.memory, self.batch, self.updates = memory, batch, updates

    def enter(self, phase: Phase) -> None:
        self.buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(self.memory), batch_size=self.batch)
        # Without done_keys=[] the transform keeps `terminated` of the first step and bootstraps through crashes.
        self.multi_step = MultiStepTransform(n_steps=phase.n_step, gamma=phase.gamma, done_keys=[])

    def collect(self, chunk: TensorDictBase) -> None:
        transitions = self.multi_step.inv(chunk)
        if transitions is not None and transitions.numel():
            self.buffer.extend(transitions.exclude("gamma", "nonterminal", ("next", "original_reward")).reshape(-1))

    def learn(self, learning_rate: float, share: float) -> None:
        if isinstance(self.rule, Compiled):
            self.rule.learn(self.buffer[:], self.batch, CHUNK * self.updates, learning_rate)
            return
        for _ in range(CHUNK * self.updates):
            self.update(self.sample(share), learning_rate)

    def sample(self, share: float) -> TensorDictBase:
        """A batch of transitions: `truth` is the stored observation, `observation` is after `hooks.replayed`."""
        sample = self.buffer.sample()
        truth = sample["observation"]
        sample.set("truth", truth)
        return sample.set("observation", self.hooks.replayed(truth, self.policy, share))
