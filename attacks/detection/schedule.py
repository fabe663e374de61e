"""The learning rate of a search for a patch, and when the search ends."""

from __future__ import annotations

import torch

SMOOTH = 0.9
"""Weight of the losses before in the mean that tells a plateau: views are drawn anew in each step."""


class Schedule:
    """The learning rate of a start: a cosine over all steps, or half as much at each plateau.

    Args:
        adam: the optimiser.
        steps: most steps.
        patience: steps without a lower loss after which the start ends; 0 for a cosine.
    """

    def __init__(self, adam: torch.optim.Adam, steps: int, patience: int) -> None:
        self.patience = patience
        self.cosine = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps, adam.defaults["lr"] / 20)
        self.halving = torch.optim.lr_scheduler.ReduceLROnPlateau(
            adam, factor=0.5, patience=max(patience // 2, 1), threshold=0.0
        )
        self.mean, self.best, self.since = 0.0, torch.inf, 0

    def step(self, loss: float) -> bool:
        """Take note of the loss of a step; whether the start has ended."""
        if not self.patience:
            self.cosine.step()
            return False
        self.mean = loss if self.best == torch.inf else SMOOTH * self.mean + (1 - SMOOTH) * loss
        self.halving.step(self.mean)
        self.since = 0 if self.mean < self.best else self.since + 1
        self.best = min(self.best, self.mean)
        return self.since >= self.patience
