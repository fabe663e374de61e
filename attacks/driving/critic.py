"""The loss of a white-box attack on a continuous victim: what the victim's own critic thinks of the action."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

if TYPE_CHECKING:
    from cavbench.driving import Oracle


@dataclass(frozen=True)
class CriticLoss:
    """The victim's Q(x, mu(x')) with the true observation x; lower is better for the attacker.

    Args:
        observation: x [B, V, F].
        clean: mu(x) [B, 2].
        oracle: access to the victim; each action that is judged is a query.
        spares_braking: judge an action as if it braked no harder than the clean one. On an open road braking is the victim's
            worst action, but it causes no collision.
    """

    price: ClassVar[int] = 2
    """Queries for one point: of its action, and of the critic."""

    observation: Tensor
    clean: Tensor
    oracle: Oracle
    spares_braking: bool

    def __call__(self, action: Tensor) -> Tensor:
        """The loss [..., B] of actions [..., B, 2]."""
        if self.spares_braking:
            acceleration = torch.maximum(action[..., :1], self.clean[..., :1])
            action = torch.cat((acceleration, action[..., 1:]), -1)
        return self.oracle.value(self.observation.expand(*action.shape[:-1], *self.observation.shape[1:]), action)

    def key(self, scores: Tensor, loss: Tensor) -> Tensor:
        """The key to choose the best of several queried points: the loss."""
        return loss
