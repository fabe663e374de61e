"""NanoDet-g (RangiLyu 2021), trained on COCO by its author: a detector that others trained, from a graph of TensorFlow.js."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from cavbench.core.contracts import Facts
from cavbench.detection import Detector, DetectorVictim, Predictions
from cavbench.detection.victims import coco
from cavbench.formats import tfjs_file
from cavbench.formats.tfjs_graph import Graph
from cavbench.zoo import fetch

STRIDES = (8, 16, 32)
"""Width and height of a cell in pixels, of the three heads from fine to coarse."""
BINS = 11
"""The distance from a cell's centre to a side of the box is a distribution over 0 to 10 cells (Li et al. 2020, Eq. 3)."""
MEAN, DEVIATION = (103.53, 116.28, 123.675), (57.375, 57.12, 58.395)
"""Of the pixels in [0, 255], in the order blue, green, red, as in the author's configuration."""
HEADS = tuple(
    (f"PartitionedCall/onnx_tf_prefix_{name}", result)
    for scores, split in (("Sigmoid_154", "Split_153"), ("Sigmoid_165", "Split_164"), ("Sigmoid_176", "Split_175"))
    for name, result in ((scores, 0), (split, 1))
)
"""In the graph, of each head: scores [N, 80, h, w] and distributions [N, 4 * BINS, h, w]. What follows fits one size only."""


class NanoDetNetwork(Detector):
    """The network, for images of any size.

    Args:
        graph: returns the outputs `HEADS`.
    """

    names = coco.NAMES
    stride = STRIDES[-1]

    def __init__(self, graph: Graph) -> None:
        super().__init__()
        self.shape: dict[str, object] = {}
        self.graph = graph
        self.mean: Tensor
        self.deviation: Tensor
        for name, values in (("mean", MEAN), ("deviation", DEVIATION)):
            self.register_buffer(name, torch.tensor(values)[:, None, None] / 255)
        self.requires_grad_(False).eval()

    def predict(self, pictures: Tensor) -> Predictions:
        outputs = self.graph((pictures.flip(1) - self.mean) / self.deviation)
        heads = zip(outputs[::2], outputs[1::2], STRIDES, strict=True)
        boxes, scores = zip(*(_decoded(*head) for head in heads), strict=True)
        classes = torch.cat(scores, 1)
        return Predictions(torch.cat(boxes, 1), torch.ones_like(classes[..., 0]), classes)


def _decoded(scores: Tensor, sides: Tensor, stride: int) -> Sequence[Tensor]:
    """Boxes [N, h * w, 4] in pixels and scores [N, h * w, 80] of a head."""
    bins = torch.arange(BINS, device=sides.device, dtype=sides.dtype)
    shares = sides.unflatten(1, (4, BINS)).softmax(2)
    left, top, right, bottom = ((shares * bins[:, None, None]).sum(2) * stride).unbind(1)
    y, x = ((torch.arange(side, device=sides.device) + 0.5) * stride for side in sides.shape[2:])
    boxes = torch.stack((x - left, y[:, None] - top, x + right, y[:, None] + bottom), -1)
    return boxes.flatten(1, 2), scores.flatten(2).mT


@dataclass(frozen=True, kw_only=True)
class NanoDet(DetectorVictim):
    """NanoDet-g with its author's COCO weights, which are downloaded on first use (144.5 MB, of which 7.7 MB are kept)."""

    def zoo_name(self) -> str:
        return "nanodet"

    def load(self, seed: int, facts: Facts) -> NanoDetNetwork:
        """The same detector for any seed."""
        file = tfjs_file.read(fetch.weights("nanodet"), "nanodet")
        network = NanoDetNetwork(Graph(file, HEADS, free=True))
        network.weights_sha256 = file.sha256
        return network
