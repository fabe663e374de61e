"""Common parts of the YOLO detectors: the convolution block, batch-norm folding, and decoding of the head outputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.nn.utils import convert_conv2d_weight_memory_format
from torch.nn.utils.fusion import fuse_conv_bn_eval

from cavbench.detection import Predictions

Network = TypeVar("Network", bound=nn.Module)
Place = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""(raw box [..., 4], cell [..., 2], anchor in pixels [..., 2]) -> centre in cells [..., 2], size in pixels [..., 2]."""


class Convolution(nn.Module):
    """Convolution, batch normalisation, activation; the output's height and width are the input's, divided by `stride`."""

    def __init__(
        self, inputs: int, outputs: int, size: int, stride: int = 1, *, eps: float, activation: nn.Module
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, size, stride, padding=(size - 1) // 2, bias=False)
        self.bn: nn.Module = nn.BatchNorm2d(outputs, eps=eps)
        self.act = activation

    def forward(self, x: Tensor) -> Tensor:
        return self.act(self.bn(self.conv(x)))


def frozen(network: Network) -> Network:
    """Prepare a network for being attacked, in place: eval mode, no gradients on its weights, and faster.

    Batch normalisation with fixed statistics is folded into the convolution before it. With the channels-last memory format a
    forward pass takes little more than half the time on a CPU.
    """
    network.requires_grad_(False).eval()
    for block in network.modules():
        if isinstance(block, Convolution) and isinstance(block.bn, nn.BatchNorm2d):
            block.conv, block.bn = fuse_conv_bn_eval(block.conv, block.bn), nn.Identity()
    return convert_conv2d_weight_memory_format(network, torch.channels_last)


def decode(outputs: Sequence[Tensor], anchors: Tensor, strides: Sequence[int], place: Place) -> Predictions:
    """Decode the outputs of the heads.

    Args:
        outputs: [N, A * (5 + C), h, w] for each head: raw box, objectness and classes of A anchors in h x w cells.
        anchors: width and height in pixels, [heads, A, 2].
        strides: width and height of a cell in pixels, for each head.
        place: converts raw boxes to centres and sizes.
    """
    boxes, logits = [], []
    for output, anchor, stride in zip(outputs, anchors, strides, strict=True):
        raw = output.unflatten(1, (len(anchor), -1)).permute(0, 1, 3, 4, 2)
        y, x = (torch.arange(side).to(raw) for side in output.shape[2:])
        cell = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
        centre, size = place(raw[..., :4], cell, anchor[:, None, None])
        boxes.append(torch.cat((centre * stride - size / 2, centre * stride + size / 2), -1).flatten(1, 3))
        logits.append(raw[..., 4:].flatten(1, 3))
    objectness, classes = torch.cat(logits, 1).sigmoid().tensor_split([1], -1)
    return Predictions(torch.cat(boxes, 1), objectness.squeeze(-1), classes)
