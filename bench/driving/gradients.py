"""The gradients that a victim gives away: counted for each episode, without NaN, and without a graph that leads into it."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.driving.threat import finite


class Gradients:
    """Counts the gradients of a step.

    Args:
        radius: what an attack may change, an array [B, V, F]; entries with 0 are fixed.

    `counts` is int64 [3, B]: all gradients, those that were 0 everywhere, and those with NaN or infinity.
    """

    def __init__(self, radius: NDArray[Any]) -> None:
        self._radius = radius
        self.counts = torch.zeros(3, len(radius), dtype=torch.int64)

    def cleaned(self, gradient: Tensor, rows: Tensor | None, *, observed: bool = False) -> Tensor:
        """The gradients [..., B, n], of all episodes or of `rows`, with 0 for each entry that is NaN or infinite.

        An attack averages over the entries of a gradient, so one NaN would spoil them all: a victim with such a gradient would
        look robust.

        Args:
            gradient: as the victim's graph gives it.
            rows: the episodes.
            observed: whether it is a gradient in the observation. A NaN in a fixed entry is then not counted: it costs the
                attack nothing.
        """
        if not finite(gradient):
            lost = ~gradient.isfinite()
            gradient = gradient.masked_fill(lost, 0.0)
            if observed:
                free = torch.from_numpy(self._radius > 0).flatten(1)
                lost = lost & (free if rows is None else free[rows])
            self._add(2, lost.any(-1), rows)
        zero = ~gradient.any(-1)
        self._add(0, torch.ones_like(zero), rows)
        self._add(1, zero, rows)
        return gradient

    def _add(self, which: int, marks: Tensor, rows: Tensor | None) -> None:
        """Add the marks [..., B] to the counter of all episodes, or of `rows`."""
        added = marks.sum(tuple(range(marks.ndim - 1))) if marks.ndim > 1 else marks.long()
        if rows is None:
            self.counts[which] += added
        else:
            self.counts[which].index_add_(0, rows, added)


class Tangent(torch.autograd.Function):
    """A value [...] with a known gradient [..., n] in its first input [..., n], and no graph behind it."""

    @staticmethod
    def forward(ctx: Any, point: Tensor, value: Tensor, gradient: Tensor) -> Tensor:
        ctx.save_for_backward(gradient)
        return value.clone()

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        return outer.unsqueeze(-1) * gradient, None, None
