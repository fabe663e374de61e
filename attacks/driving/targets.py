"""The actions that an attack may try to induce in its victim: every discrete action, or a grid of continuous ones."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from cavbench.attacks.driving.objectives import TIE_BREAK, DiscreteLoss, margin, taken
from cavbench.attacks.driving.pgd import Key, Loss


class Targets(ABC):
    """T targets, by index: actions to induce."""

    count: int
    """T, the number of targets."""

    @abstractmethod
    def action(self, target: Tensor) -> Tensor:
        """The actions of the targets `target` [B]: int64 [B], or float [B, 2]."""

    @abstractmethod
    def loss(self, scores: Tensor, target: Tensor) -> Tensor:
        """How far the victim is from the targets `target` [..., B], from its scores; lower is closer."""

    @abstractmethod
    def pursuit(self, values: Tensor, starts: int) -> tuple[int, Loss, Key]:
        """Restarts, loss and key of a descent that induces the best target that can be induced.

        Args:
            values: the value of each target for the attacker [B, T].
            starts: starts for each target.
        """


class EveryAction(Targets):
    """All A actions of a discrete victim.

    Args:
        count: A.
    """

    def __init__(self, count: int) -> None:
        self.count = count

    def action(self, target: Tensor) -> Tensor:
        return target

    def loss(self, scores: Tensor, target: Tensor) -> Tensor:
        return -margin(scores, target)

    def pursuit(self, values: Tensor, starts: int) -> tuple[int, Loss, Key]:
        """Restarts descend towards every action; the key of a point is the rank of the action that the victim takes there."""
        order = values.argsort(dim=-1, descending=True)
        rank, wanted = order.argsort(-1), order.T.repeat(starts, 1)

        def loss(scores: Tensor) -> Tensor:
            return self.loss(scores, wanted[: len(scores)])

        def key(scores: Tensor, loss: Tensor) -> Tensor:
            return taken(scores, rank) + TIE_BREAK * loss.tanh()

        return len(wanted), loss, key


class EveryActionAndWorst(EveryAction):
    """All A actions of a discrete victim, and a last target: the worst action by the victim's own scores.

    Args:
        worst: the loss towards the victim's worst action, with its scores of the true observations.
    """

    def __init__(self, worst: DiscreteLoss) -> None:
        self.actions = worst.clean.shape[-1]
        super().__init__(self.actions + 1)
        self.worst = worst

    def loss(self, scores: Tensor, target: Tensor) -> Tensor:
        to_action = super().loss(scores, target.clamp(max=self.actions - 1))
        return torch.where(target == self.actions, self.worst(scores), to_action)

    def pursuit(self, values: Tensor, starts: int) -> tuple[int, Loss, Key]:
        leads = values.argmax(-1) == self.actions
        restarts, to_actions, rank = super().pursuit(values[:, : self.actions], starts)

        def loss(scores: Tensor) -> Tensor:
            return torch.where(leads, self.worst(scores), to_actions(scores))

        def key(scores: Tensor, loss: Tensor) -> Tensor:
            return torch.where(leads, self.worst.key(scores, loss), rank(scores, loss))

        return restarts, loss, key


class Controls(Targets):
    """Nine continuous actions: full brake, coast or full throttle, each with a turn to the left, none or to the right.

    Args:
        steering: |steering| of a turn, in (0, 1]; distances in steering are measured in this unit.
    """

    def __init__(self, steering: float) -> None:
        self.unit = torch.tensor([1.0, steering])
        self.grid = torch.cartesian_prod(torch.tensor([-1.0, 0.0, 1.0]), torch.tensor([-1.0, 0.0, 1.0]))
        self.count = len(self.grid)

    def action(self, target: Tensor) -> Tensor:
        return self.grid[target] * self.unit

    def loss(self, scores: Tensor, target: Tensor) -> Tensor:
        return (scores / self.unit.to(scores) - self.grid.to(scores)[target]).square().sum(-1)

    def pursuit(self, values: Tensor, starts: int) -> tuple[int, Loss, Key]:
        """All restarts descend towards the best target: a continuous action can always be induced in part."""
        wanted = values.argmax(-1).expand(starts * self.count, -1)

        def loss(scores: Tensor) -> Tensor:
            return self.loss(scores, wanted[: len(scores)])

        return len(wanted), loss, lambda _, loss: loss
