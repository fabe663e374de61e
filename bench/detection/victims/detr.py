"""A detector of the DETR family (Carion et al. 2020): queries that attend to each other and to the image become a set of objects.

The queries are the surest cells of a convolutional encoder, as in the two-stage Deformable DETR (Zhu et al. 2021) and in RT-DETR
(Zhao et al. 2024). No non-maximum suppression removes duplicates: the queries learn it from the matching (`matching`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from cavbench import zoo
from cavbench.core.contracts import Facts
from cavbench.core.ranges import Count
from cavbench.detection import Detector, Predictions
from cavbench.detection.victims import fcos, matching, yolo
from cavbench.detection.victims.examples import Example
from cavbench.detection.victims.fcos import FCOS, PYRAMID, RARE, WIDTHS, FCOSNetwork, Raw
from cavbench.detection.victims.learner import Learner
from cavbench.detection.victims.matching import Answer

QUERIES = 80
LAYERS = 3
HIDDEN, INNER = 64, 128
"""Width of the queries, and of the hidden layer between two attentions."""
HEADS = 8
POINTS = 4
"""Points at which a head looks at a map of features, for each query."""
MAPS = ((4, WIDTHS[1]), (fcos.STRIDES[0], PYRAMID), (fcos.STRIDES[1], PYRAMID))
"""Stride and channels of the features that the queries see: the stem's, and the two finest of the pyramid."""
RELATION = 16
FIRST_COPIES = 4
"""Queries that learn an object in the first layer."""
LIMIT = 2.0
"""Most that a side of a box grows or shrinks in a layer, as a logarithm."""
LEAST = 1.0
"""Sides of boxes are at least so many pixels where they are divided by."""


def middle_and_size(boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Middles and sizes, both [..., 2] in pixels, of boxes [..., 4]."""
    return (boxes[..., :2] + boxes[..., 2:]) / 2, (boxes[..., 2:] - boxes[..., :2]).clamp(min=LEAST)


class Together(nn.Module):
    """Self-attention of the queries. What is added to a weight depends on how the two boxes lie to each other (Hu et al. 2018).

    Without positions in the image, the same objects are found in an image of any size.
    """

    def __init__(self) -> None:
        super().__init__()
        self.inputs, self.outputs = nn.Linear(HIDDEN, 3 * HIDDEN), nn.Linear(HIDDEN, HIDDEN)
        self.relation = nn.Sequential(nn.Linear(4, RELATION), nn.ReLU(), nn.Linear(RELATION, HEADS))

    def forward(self, queries: Tensor, boxes: Tensor) -> Tensor:
        """[N, K, `HIDDEN`] for queries [N, K, `HIDDEN`] at boxes [N, K, 4] in pixels."""
        middle, size = middle_and_size(boxes)
        apart = (middle.unsqueeze(1) - middle.unsqueeze(2)).abs() / size.unsqueeze(2)
        larger = (size.unsqueeze(1) / size.unsqueeze(2)).log()
        relation = self.relation(torch.cat((apart.log1p(), larger), -1)).movedim(-1, 1)
        parts = self.inputs(queries).unflatten(-1, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        asked, known, value = parts
        weights = (asked @ known.mT / math.sqrt(HIDDEN / HEADS) + relation).softmax(-1)
        return self.outputs((weights @ value).transpose(1, 2).flatten(2))


class Look(nn.Module):
    """Multi-scale deformable attention (Zhu et al. 2021, Eq. 3): each head sees a few points around the box of its query."""

    def __init__(self) -> None:
        super().__init__()
        self.values = nn.ModuleList(nn.Conv2d(channels, HIDDEN, 1) for _, channels in MAPS)
        self.offsets = nn.Linear(HIDDEN, HEADS * len(MAPS) * POINTS * 2)
        self.weights = nn.Linear(HIDDEN, HEADS * len(MAPS) * POINTS)
        self.outputs = nn.Linear(HIDDEN, HIDDEN)
        # As in the paper: each head looks in a direction of its own at first, to the edge of the box.
        angles = torch.arange(HEADS) * (2 * math.pi / HEADS)
        directions = torch.stack((angles.cos(), angles.sin()), -1)
        directions = directions / directions.abs().amax(-1, keepdim=True)
        steps = (torch.arange(POINTS) + 1) / POINTS
        start = directions[:, None, None] * steps[:, None].expand(len(MAPS), POINTS, 1)
        for layer in (self.offsets, self.weights):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        self.offsets.bias.data = start.flatten()

    def forward(self, queries: Tensor, boxes: Tensor, features: Sequence[Tensor]) -> Tensor:
        """[N, K, `HIDDEN`] for queries [N, K, `HIDDEN`] at boxes [N, K, 4] in pixels.

        Args:
            queries: the queries.
            boxes: their boxes.
            features: one [N, c, h, w] for each of `MAPS`.
        """
        middle, size = middle_and_size(boxes)
        offsets = self.offsets(queries).unflatten(-1, (HEADS, len(MAPS), POINTS, 2))
        at = middle[:, :, None, None, None] + offsets * size[:, :, None, None, None] / 2
        seen = []
        for number, ((stride, _), feature, layer) in enumerate(zip(MAPS, features, self.values, strict=True)):
            height, width = feature.shape[2:]
            value = layer(feature).unflatten(1, (HEADS, -1)).flatten(0, 1)
            grid = 2 * at[:, :, :, number] / (stride * at.new_tensor([width, height])) - 1
            grid = grid.transpose(1, 2).flatten(0, 1)
            seen.append(functional.grid_sample(value, grid, padding_mode="border", align_corners=False))
        points = torch.cat(seen, -1).unflatten(0, (-1, HEADS))
        weights = self.weights(queries).unflatten(-1, (HEADS, -1)).softmax(-1).transpose(1, 2)
        return self.outputs((points * weights.unsqueeze(2)).sum(-1).permute(0, 3, 1, 2).flatten(2))


class Layer(nn.Module):
    """A layer of the decoder: the queries attend to each other and to the image, name their objects, and move their boxes.

    Args:
        classes: number of classes.
    """

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.size = nn.Linear(2, HIDDEN)
        self.together, self.look = Together(), Look()
        self.think = nn.Sequential(nn.Linear(HIDDEN, INNER), nn.ReLU(), nn.Linear(INNER, HIDDEN))
        self.norms = nn.ModuleList(nn.LayerNorm(HIDDEN) for _ in range(3))
        self.name = nn.Linear(HIDDEN, classes)
        self.move = nn.Sequential(nn.Linear(HIDDEN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 4))
        nn.init.constant_(self.name.bias, RARE)
        for parameter in self.move[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(self, queries: Tensor, boxes: Tensor, features: Sequence[Tensor]) -> tuple[Tensor, Answer]:
        """The queries [N, K, `HIDDEN`] after this layer, and its answer, given their boxes [N, K, 4] before it."""
        middle, size = middle_and_size(boxes)
        sized = self.size((size / fcos.STRIDES[0]).log())
        first, second, third = self.norms
        queries = first(queries + self.together(queries + sized, boxes))
        queries = second(queries + self.look(queries + sized, boxes, features))
        queries = third(queries + self.think(queries))
        # The parametrisation of boxes of Ren et al. 2015 (Faster R-CNN, Eq. 2).
        moved = self.move(queries)
        middle = middle + moved[..., :2] * size
        size = size * moved[..., 2:].clamp(-LIMIT, LIMIT).exp()
        return queries, Answer(torch.cat((middle - size / 2, middle + size / 2), -1), self.name(queries))


class DETRNetwork(Detector):
    """The network: an FCOS with the only class "object" as encoder, and the decoder.

    Args:
        names: class names.
    """

    stride = fcos.STRIDES[-1]
    aligned = False

    def __init__(self, names: tuple[str, ...]) -> None:
        super().__init__()
        self.shape = {"names": names}
        self.names = tuple(names)
        self.first = FCOSNetwork(("object",))
        self.begin = nn.Sequential(nn.Linear(PYRAMID, HIDDEN), nn.LayerNorm(HIDDEN))
        self.layers = nn.ModuleList(Layer(len(names)) for _ in range(LAYERS))

    def answers(self, pictures: Tensor) -> tuple[Raw, list[Answer]]:
        """The outputs of the encoder on images [N, 3, H, W], and the answers of the layers, of K queries each."""
        stem = self.first.stem(pictures)
        levels = self.first.levels(stem)
        raw = self.first.at_cells(levels)
        sure = raw.classes[..., 0].sigmoid() * raw.centreness.sigmoid()
        best = sure.topk(min(QUERIES, sure.shape[1]), 1).indices.unsqueeze(-1)
        boxes = raw.boxes.gather(1, best.expand(-1, -1, 4))
        cells = torch.cat([level.flatten(2).mT for level in levels], 1)
        queries = self.begin(cells.gather(1, best.expand(-1, -1, PYRAMID)))
        answers: list[Answer] = []
        for layer in self.layers:
            # While it learns, a layer does not move the boxes of those before it (Zhu et al. 2021, section 4.2).
            queries, answer = layer(queries, boxes.detach() if self.training else boxes, (stem, *levels[:2]))
            answers.append(answer)
            boxes = answer.boxes
        return raw, answers

    def predict(self, pictures: Tensor) -> Predictions:
        last = self.answers(pictures)[1][-1]
        return Predictions(last.boxes, torch.ones_like(last.boxes[..., 0]), last.logits.sigmoid())


def loss(network: DETRNetwork, example: Example) -> Tensor:
    """FCOS's loss of the encoder with the class "object", and the loss of each layer's set of objects.

    The first layer may find an object several times (the hybrid layer scheme of Jia et al. 2023), the others once.
    """
    raw, answers = network.answers(example.pictures)
    lost = fcos.loss(raw, example.boxes, [torch.zeros_like(label) for label in example.labels])
    for number, answer in enumerate(answers):
        lost = lost + matching.loss(answer, example, copies=1 if number else FIRST_COPIES)
    return lost


@dataclass(frozen=True, kw_only=True)
class DETR(Learner[DETRNetwork]):
    """A detector of the DETR family, of 2.3 million parameters, trained on the camera world's training places, with decoys.

    Args:
        trained: training seed of the zoo's detector; the seeds of a run are patch seeds.
        updates: number of weight updates in training.
        batch: windows per update.
        window: side of a window in pixels, a multiple of 32.
        away: share of the windows at uniformly random places; the others are near the sign.
        decoys: share of the windows with a decoy in the place of the stop sign.
        learning_rate: maximum learning rate of AdamW.
        trained_in: non-default parameters of the training world; set by `bench train`.
    """

    decay: ClassVar[float] = 0.99

    updates: Count = 600
    batch: Count = 8
    window: int = 256

    def zoo_name(self) -> str:
        return "detr"

    def load(self, seed: int, facts: Facts) -> DETRNetwork:
        """The zoo's detector, the same for any seed."""
        return yolo.frozen(zoo.load(zoo.Recipe.of(self), self.trained, DETRNetwork))

    def begun(self, names: tuple[str, ...]) -> DETRNetwork:
        """Random weights, but in the encoder those of the zoo's `fcos`, without its score. The backbone keeps them."""
        network = DETRNetwork(names)
        known = zoo.load(zoo.Recipe.of(FCOS()), FCOS().trained, FCOSNetwork).state_dict()
        own = network.first.state_dict()
        network.first.load_state_dict({**known, **{name: own[name] for name in own if name.startswith("score.")}})
        network.first.stem.requires_grad_(False)
        network.first.stages.requires_grad_(False)
        return network

    def loss(self, network: DETRNetwork, example: Example) -> Tensor:
        return loss(network, example)
