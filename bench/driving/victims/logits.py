"""The networks of policies that draw their actions in training: the logits of a softmax, and a soft actor-critic."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import ProbabilisticTensorDictModule
from torch import Tensor, nn

from cavbench.driving import State
from cavbench.driving.victims.networks import QNetwork, QPolicy, whatever_the_batch


class Logits(nn.Module):
    """The logits [..., A] of a network; those of actions that are not allowed are next to impossible."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: Tensor, allowed: Tensor | None = None) -> Tensor:
        logits: Tensor = self.network(observation)
        return logits if allowed is None else logits.masked_fill(~allowed, -1e4)


class SoftPolicy(QPolicy):
    """The most likely action of a soft actor-critic, with the critics of its training; the scores are the actor's logits.

    Args:
        features, actions, hidden: as of `QPolicy`; the actor and each critic have their own encoder.
        critics: number of critics.

    `temperature` is the alpha of the training, on the scale of the critics; a training that continues starts with it.
    """

    def __init__(self, features: int, actions: int, hidden: int, critics: int = 1) -> None:
        super().__init__(features, actions, hidden)
        self.shape["critics"] = critics
        self.critics = nn.ModuleList(QNetwork(features, actions, hidden) for _ in range(critics))
        self.temperature: Tensor
        self.register_buffer("temperature", torch.tensor(1.0))

    def values(self, observation: Tensor) -> Tensor:
        """The soft Q-values of the actions [..., A]: the smallest of the critics'."""
        return torch.stack([whatever_the_batch(critic, observation) for critic in self.critics]).amin(0)

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        return self.values(observation).gather(-1, action.unsqueeze(-1)).squeeze(-1)


def sampled(**more: Any) -> ProbabilisticTensorDictModule:
    """Draws an `action` from the softmax of `logits`, with its `action_log_prob`; `more` as of the module of tensordict."""
    return ProbabilisticTensorDictModule(
        in_keys=["logits"],
        out_keys=["action"],
        distribution_class=torch.distributions.Categorical,
        distribution_kwargs={"validate_args": False},
        return_log_prob=True,
        log_prob_key="action_log_prob",
        **more,
    )
