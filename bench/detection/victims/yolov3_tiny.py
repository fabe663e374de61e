"""YOLOv3-tiny (Redmon and Farhadi 2018) as a torch module, with the official COCO weights in Darknet's format."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from cavbench.core.contracts import Facts
from cavbench.detection import Detector, DetectorVictim, Predictions
from cavbench.detection.victims import coco, yolo
from cavbench.errors import UserError
from cavbench.zoo import fetch

ANCHORS = ((10, 14), (23, 27), (37, 58), (81, 82), (135, 169), (344, 319))
"""Width and height in pixels, for any image size."""
HEADS = ((3, 4, 5), (1, 2, 3))
"""The anchors of the coarse and of the fine head.

The cfg file published with the weights has 0, 1, 2 for the fine head, but its boxes are then far too small: their IoU with a
stop sign is 0.2 to 0.4, and 0.75 to 0.9 with 1, 2, 3. Scores do not depend on the anchors.
"""
HEADER = 20
"""Size of the file header in bytes."""


def _leaky(inputs: int, outputs: int, size: int = 3) -> yolo.Convolution:
    return yolo.Convolution(inputs, outputs, size, eps=1e-6, activation=nn.LeakyReLU(0.1, inplace=True))


class YOLOv3TinyNetwork(Detector):
    """The network; its modules are in the order of the weights file."""

    names = coco.NAMES
    stride = 32

    def __init__(self) -> None:
        super().__init__()
        self.shape: dict[str, object] = {}
        outputs = len(HEADS[0]) * (5 + len(self.names))
        widths = (3, 16, 32, 64, 128, 256)
        self.stem = nn.ModuleList(_leaky(a, b) for a, b in pairwise(widths))
        self.deep = nn.Sequential(_leaky(256, 512), _SamePool(), _leaky(512, 1024), _leaky(1024, 256, 1))
        self.coarse = nn.Sequential(_leaky(256, 512), nn.Conv2d(512, outputs, 1))
        self.lateral = nn.Sequential(_leaky(256, 128, 1), nn.Upsample(scale_factor=2))
        self.fine = nn.Sequential(_leaky(384, 256), nn.Conv2d(256, outputs, 1))
        self.anchors: Tensor
        self.register_buffer("anchors", torch.tensor(ANCHORS, dtype=torch.float32)[torch.tensor(HEADS)])

    def predict(self, pictures: Tensor) -> Predictions:
        x = pictures
        for block in self.stem:
            middle = block(x)
            x = nn.functional.max_pool2d(middle, 2)
        deep = self.deep(x)
        fine = self.fine(torch.cat((self.lateral(deep), middle), 1))
        return yolo.decode((self.coarse(deep), fine), self.anchors, (32, 16), _place)


class _SamePool(nn.Module):
    """2 x 2 max pooling with stride 1 and Darknet's padding: -inf beyond the right and the lower edge."""

    def forward(self, x: Tensor) -> Tensor:
        return nn.functional.max_pool2d(nn.functional.pad(x, (0, 1, 0, 1), value=-torch.inf), 2, 1)


def _place(raw: Tensor, cell: Tensor, anchor: Tensor) -> tuple[Tensor, Tensor]:
    """Redmon and Farhadi 2018, section 2.1: centre sigma(t) + c, size p exp(t)."""
    return raw[..., :2].sigmoid() + cell, raw[..., 2:].exp() * anchor


def read_darknet(path: Path, network: nn.Module) -> None:
    """Load the weights of a Darknet file into a network.

    The file has a header of 20 bytes (version, number of training images), then little-endian float32 values. For each
    convolution in order: bias; scale, mean and variance if it has batch normalisation; kernel.

    Raises:
        UserError: if the size of the file does not match the network.
    """
    tensors = [tensor for tensor in _in_order(network) if tensor is not None]
    sizes = [tensor.numel() for tensor in tensors]
    found, wanted = path.stat().st_size, HEADER + 4 * sum(sizes)
    if found != wanted:
        raise UserError(f"the weights {path} have {found} bytes, {type(network).__name__} needs {wanted}")
    values = torch.from_numpy(np.fromfile(path, "<f4", offset=HEADER))
    for tensor, part in zip(tensors, values.split(sizes), strict=True):
        tensor.data.copy_(part.view_as(tensor))


def _in_order(module: nn.Module) -> Iterator[Tensor | None]:
    match module:
        case yolo.Convolution(conv=conv, bn=nn.BatchNorm2d() as bn):
            yield from (bn.bias, bn.weight, bn.running_mean, bn.running_var, conv.weight)
        case nn.Conv2d():
            yield from (module.bias, module.weight)
        case _:
            for child in module.children():
                yield from _in_order(child)


@dataclass(frozen=True, kw_only=True)
class YOLOv3Tiny(DetectorVictim):
    """The smallest YOLOv3, with its authors' COCO weights, which are downloaded on first use."""

    def zoo_name(self) -> str:
        return "yolov3_tiny"

    def load(self, seed: int, facts: Facts) -> YOLOv3TinyNetwork:
        """The same detector for any seed."""
        path = fetch.weights("yolov3_tiny")
        network = YOLOv3TinyNetwork()
        read_darknet(path, network)
        network.weights_sha256 = fetch.DOWNLOADS["yolov3_tiny"].sha256
        return yolo.frozen(network)
