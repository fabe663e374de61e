"""ShakeDrop: residual branches of a network are scaled at random, as if each step asked another relative of the network.

Yamada et al. 2018, arXiv 1802.02375, with the factors of T-SEA (Huang et al. 2023, arXiv 2211.09773), whose mean is 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn

from cavbench.detection.victims.fcos import Residual
from cavbench.detection.victims.yolov5 import Bottleneck

FACTORS = 2.0
"""Factors are uniform between 0 and this number."""


class _Scaled(torch.autograd.Function):
    """x times one factor for each image; its gradient has factors of its own."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, forwards: Tensor, backwards: Tensor) -> Tensor:
        ctx.save_for_backward(backwards)
        return x * forwards

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (backwards,) = ctx.saved_tensors
        return gradients[0] * backwards, None, None


def branches(network: nn.Module) -> Iterator[nn.Module]:
    """The last layer of each residual branch: what it returns is added to the branch's input."""
    for module in network.modules():
        if isinstance(module, Residual):
            yield module.second
        elif isinstance(module, Bottleneck) and module.shortcut:
            yield module.cv2


def shake(network: nn.Module, probability: float, generator: torch.Generator) -> int:
    """Make a network shake its residual branches whenever it is asked.

    Args:
        network: is changed; a network without such branches stays as it is.
        probability: of each branch in each forward pass.
        generator: draws which branches, and their factors.

    Returns:
        How many branches it has.
    """

    def scaled(layer: nn.Module, inputs: tuple[Tensor, ...], x: Tensor) -> Tensor | None:
        if torch.rand((), generator=generator) >= probability:
            return None
        factors = FACTORS * torch.rand((2, len(x), *(1,) * (x.ndim - 1)), generator=generator).to(x)
        return _Scaled.apply(x, *factors)

    found = list(branches(network))
    for layer in found:
        layer.register_forward_hook(scaled)
    return len(found)
