"""Double Q-learning in compiled calls. `cavbench.driving.victims.dqn` has the same with torch, which is the reference."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from cavbench.driving.fused import learning
from cavbench.driving.fused.network import Fused
from cavbench.driving.fused.trainable import Trainable


@dataclass(frozen=True)
class Transitions:
    """Transitions of a replay buffer [N].

    Args:
        observation, action: what was seen [N, V, F] and done [N].
        reward: the n-step return [N].
        steps: the decisions in it [N].
        failed: whether it ended in a failure [N].
        after: the last observation of the return [N, V, F].
        allowed, allowed_after: the actions that a defence leaves at both [N, A]; None for all.
    """

    observation: Tensor
    action: Tensor
    reward: Tensor
    steps: Tensor
    failed: Tensor
    after: Tensor
    allowed: Tensor | None
    allowed_after: Tensor | None

    @classmethod
    def of(cls, stored: TensorDictBase, mask: str | None) -> Transitions:
        """The transitions of a buffer, as views; `mask` is the key of the allowed actions."""
        after = stored["next"]
        return cls(
            stored["observation"],
            stored["action"],
            after["reward"].reshape(-1),
            stored["steps_to_next_obs"].reshape(-1),
            after["terminated"].reshape(-1),
            after["observation"],
            None if mask is None else stored[mask],
            None if mask is None else after[mask],
        )

    def __len__(self) -> int:
        return len(self.action)

    def __getitem__(self, rows: Tensor) -> Transitions:
        return replace(self, **{name: value[rows] for name, value in vars(self).items() if value is not None})


class QLearning:
    """Updates a Q-network on batches of transitions, and keeps its target network.

    The loss is the smooth L1 distance to double Q-learning's target; a target network follows with rate `tau`.

    Args:
        fused: the network in training.
        tau: rate of the target network's soft update.
        longest: norm to which a gradient is clipped.
    """

    def __init__(self, fused: Fused, *, tau: float, longest: float) -> None:
        self.network, self.tau, self.longest = Trainable(fused), tau, longest
        self.target = self.network.weights.copy()

    def scores(self, observation: Tensor) -> Tensor:
        """Q(s, .) [N, A] of the network in training."""
        return self.network.answers(observation)

    def update(self, batch: Transitions, *, gamma: float, gap: float, rate: float) -> None:
        """One gradient step; `gamma` is the discount of a decision, `gap` that of advantage learning."""
        discount = gamma**batch.steps * ~batch.failed
        after = self.network.answers(batch.after)
        targets = self.network.answers(batch.after, weights=self.target)
        values = self.network.forward(batch.observation)
        by_values, every = torch.empty_like(values), torch.ones_like(values, dtype=torch.bool)
        learning.errors(
            values.numpy(),
            after.numpy(),
            targets.numpy(),
            batch.action.numpy(),
            batch.reward.numpy(),
            discount.numpy(),
            gap,
            (every if batch.allowed is None else batch.allowed).numpy(),
            (every if batch.allowed_after is None else batch.allowed_after).numpy(),
            by_values.numpy(),
        )
        self.network.backward(by_values)
        self.network.step(rate, longest=self.longest, average=self.target, tau=self.tau)

    def averaged(self, fused: Fused) -> None:
        """Copy the weights of the target network into another network of the same shape."""
        fused.assign(torch.from_numpy(self.target))


class Greedy(nn.Module):
    """Writes the `action` with the largest value of those that are allowed, for observations [N, V, F] in a tensordict."""

    def __init__(self, learning: QLearning, mask: str | None) -> None:
        super().__init__()
        self.learning, self.mask = learning, mask

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        values = self.learning.scores(tensordict["observation"])
        if self.mask is not None:
            values = values.masked_fill(~tensordict[self.mask], -torch.inf)
        return tensordict.set("action", values.argmax(-1))
