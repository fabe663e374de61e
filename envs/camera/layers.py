"""Pictures of which only small parts have a graph: the gradient is as small as these parts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

Where = tuple[int, slice, slice]
"""A picture's number, its rows and its columns."""


def joined(pictures: Tensor, where: Sequence[Where], parts: Sequence[Tensor]) -> Tensor:
    """Write parts into pictures [N, 3, H, W], which have no graph, in place; differentiable in the parts.

    Plain assignments would give each of them a gradient of all pictures.

    Args:
        pictures: float [N, 3, H, W].
        where: the place of each part; no two places overlap.
        parts: [3, h, w] each.
    """
    found: Tensor = _Joined.apply(pictures, where, *parts)
    return found


class _Joined(Function):
    @staticmethod
    def forward(ctx: Any, pictures: Tensor, where: Sequence[Where], *parts: Tensor) -> Tensor:
        ctx.where = where
        ctx.mark_dirty(pictures)
        for (number, rows, columns), part in zip(where, parts, strict=True):
            pictures[number, :, rows, columns] = part
        return pictures

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, *(gradient[number, :, rows, columns] for number, rows, columns in ctx.where)
