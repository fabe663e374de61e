"""FCOS (Tian et al. 2019): an anchor-free detector. Every cell within an object predicts the distances to its four sides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from cavbench import zoo
from cavbench.core.contracts import Facts
from cavbench.detection import Detector, Predictions
from cavbench.detection.victims import yolo
from cavbench.detection.victims.examples import Example
from cavbench.detection.victims.learner import Learner

STRIDES = (8, 16, 32)
REACHES = ((0.0, 48.0), (48.0, 96.0), (96.0, torch.inf))
"""Largest distance from a cell to a side of its object, in pixels, for each level (section 3.2)."""
RADIUS = 1.5
"""Cells nearer than this many strides to the centre of an object learn it (centre sampling)."""
WIDTHS = (24, 32, 64, 128, 192)
"""Channels at strides 2 to 32."""
PYRAMID = 64
"""Channels of the levels and of the head."""
GROUPS = 8
ALPHA, GAMMA = 0.25, 2.0
"""Of the focal loss (Lin et al. 2017, Eq. 5)."""
RARE = -4.6
"""Initial bias of the classes: a score of 0.01."""


def _relu(inputs: int, outputs: int, size: int = 3, stride: int = 1) -> yolo.Convolution:
    return yolo.Convolution(inputs, outputs, size, stride, eps=1e-5, activation=nn.ReLU(inplace=True))


class Residual(nn.Module):
    """A basic block (He et al. 2016): two 3 x 3 convolutions, added to the input."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = _relu(inputs, outputs, 3, stride)
        self.second = yolo.Convolution(outputs, outputs, 3, eps=1e-5, activation=nn.Identity())
        plain = inputs == outputs and stride == 1
        self.beside = (
            nn.Identity() if plain else yolo.Convolution(inputs, outputs, 1, stride, eps=1e-5, activation=nn.Identity())
        )

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(self.second(self.first(x)) + self.beside(x))


@dataclass(frozen=True)
class Raw:
    """Outputs at P cells of all levels: distances to left, top, right and bottom in pixels [N, P, 4], logits [N, P, C] of the
    classes and [N, P] of centre-ness; and of the cells the centres [P, 2] in pixels and the strides [P]."""

    distances: Tensor
    classes: Tensor
    centreness: Tensor
    cells: Tensor
    strides: Tensor

    @property
    def boxes(self) -> Tensor:
        """[N, P, 4] in pixels."""
        return torch.cat((self.cells - self.distances[..., :2], self.cells + self.distances[..., 2:]), -1)


class FCOSNetwork(Detector):
    """The network: a small residual network, a feature pyramid, and one head for all levels.

    Args:
        names: class names.
    """

    stride = STRIDES[-1]

    def __init__(self, names: tuple[str, ...]) -> None:
        super().__init__()
        self.shape = {"names": names}
        self.names = tuple(names)
        w2, w4, w8, w16, w32 = WIDTHS
        self.stem = nn.Sequential(_relu(3, w2, 6, 2), _relu(w2, w4, 3, 2), Residual(w4, w4, 1))
        self.stages = nn.ModuleList(
            nn.Sequential(Residual(a, b, 2), Residual(b, b, 1)) for a, b in ((w4, w8), (w8, w16), (w16, w32))
        )
        self.lateral = nn.ModuleList(nn.Conv2d(width, PYRAMID, 1) for width in (w8, w16, w32))
        self.head = nn.Sequential(
            *(
                layer
                for _ in range(2)
                for layer in (nn.Conv2d(PYRAMID, PYRAMID, 3, padding=1), nn.GroupNorm(GROUPS, PYRAMID), nn.ReLU())
            )
        )
        self.score = nn.Conv2d(PYRAMID, len(names), 3, padding=1)
        self.place = nn.Conv2d(PYRAMID, 5, 3, padding=1)
        self.scales = nn.Parameter(torch.ones(len(STRIDES)))
        nn.init.constant_(self.score.bias, RARE)  # type: ignore[arg-type]

    def raw(self, pictures: Tensor) -> Raw:
        """The outputs for images [N, 3, H, W]."""
        return self.at_cells(self.levels(self.stem(pictures)))

    def levels(self, x: Tensor) -> list[Tensor]:
        """The feature pyramid, [N, `PYRAMID`, h, w] at each of `STRIDES`, from the output of the stem [N, 32, H / 4, W / 4]."""
        features = []
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        levels: list[Tensor] = []
        for lateral, feature in zip(reversed(self.lateral), reversed(features), strict=True):
            level = lateral(feature)
            levels.insert(0, level + functional.interpolate(levels[0], scale_factor=2) if levels else level)
        return levels

    def at_cells(self, levels: Sequence[Tensor]) -> Raw:
        """The outputs of the head on the levels of the pyramid."""
        parts: list[tuple[Tensor, ...]] = []
        for level, stride, scale in zip(levels, STRIDES, self.scales, strict=True):
            hidden = self.head(level)
            place = self.place(hidden).flatten(2).mT
            y, x = ((torch.arange(side).to(place) + 0.5) * stride for side in level.shape[2:])
            cells = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).flatten(0, 1)
            distances = functional.softplus(place[..., :4] * scale) * stride
            parts.append((distances, self.score(hidden).flatten(2).mT, place[..., 4], cells, cells[:, 0] * 0 + stride))
        distance, score, central, cell, stride_of = zip(*parts, strict=True)
        return Raw(
            torch.cat(distance, 1), torch.cat(score, 1), torch.cat(central, 1), torch.cat(cell), torch.cat(stride_of)
        )

    def predict(self, pictures: Tensor) -> Predictions:
        raw = self.raw(pictures)
        return Predictions(raw.boxes, raw.centreness.sigmoid(), raw.classes.sigmoid())


def loss(raw: Raw, boxes: Sequence[Tensor], labels: Sequence[Tensor]) -> Tensor:
    """The loss of FCOS (Eq. 2, with centre sampling and GIoU): focal loss of the classes, boxes, centre-ness.

    Args:
        raw: outputs on N images.
        boxes: [K_n, 4] true boxes of each image, in pixels.
        labels: int64 [K_n] true labels of each image.
    """
    wanted = torch.zeros_like(raw.classes)
    own = torch.zeros_like(raw.distances)
    for number, (box, label) in enumerate(zip(boxes, labels, strict=True)):
        if len(box):
            mine, owner, distances = _assigned(raw, box)
            wanted[number, mine, label[owner]] = 1.0
            own[number, mine] = distances
    mine = wanted.amax(-1) > 0
    count = mine.sum().clamp(min=1)
    entropy = functional.binary_cross_entropy_with_logits(raw.classes, wanted, reduction="none")
    right = torch.where(wanted > 0, raw.classes.sigmoid(), 1 - raw.classes.sigmoid())
    classes = (torch.where(wanted > 0, ALPHA, 1 - ALPHA) * (1 - right) ** GAMMA * entropy).sum()
    target = own[mine]
    short, long = target.unflatten(-1, (2, 2)).aminmax(dim=-2)
    centred = (short.clamp(min=0) / long.clamp(min=1e-6)).prod(-1).sqrt()
    places = (centred * _unlike(raw.distances[mine], target)).sum() / centred.sum().clamp(min=1e-6)
    centreness = functional.binary_cross_entropy_with_logits(raw.centreness[mine], centred, reduction="sum")
    return (classes + centreness) / count + places


def _assigned(raw: Raw, boxes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """For one image: bool [P] which cells learn an object, and of those the index of the object and the distances [., 4]."""
    low = raw.cells[:, None] - boxes[:, :2]
    high = boxes[:, 2:] - raw.cells[:, None]
    distances = torch.cat((low, high), -1)
    largest = distances.amax(-1)
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    near = (raw.cells[:, None] - middle).abs().amax(-1) < RADIUS * raw.strides[:, None]
    reach = largest.new_tensor(REACHES)[(raw.strides.log2() - 3).long()]
    fits = (distances.amin(-1) > 0) & near & (largest >= reach[:, :1]) & (largest < reach[:, 1:])
    area = (boxes[:, 2:] - boxes[:, :2]).prod(-1).expand_as(largest).where(fits, torch.inf)
    smallest, owner = area.min(1)
    mine = smallest < torch.inf
    return mine, owner[mine], distances[mine, owner[mine]]


def _unlike(a: Tensor, b: Tensor) -> Tensor:
    """[M] 1 - generalised IoU (Rezatofighi et al. 2019) of boxes around the same cell, given as distances [M, 4]."""

    def area(distances: Tensor) -> Tensor:
        return (distances[:, :2] + distances[:, 2:]).prod(-1)

    shared = area(torch.minimum(a, b))
    union = area(a) + area(b) - shared
    hull = area(torch.maximum(a, b))
    return 1 - shared / union.clamp(min=1e-6) + (hull - union) / hull.clamp(min=1e-6)


@dataclass(frozen=True, kw_only=True)
class FCOS(Learner[FCOSNetwork]):
    """An anchor-free detector of 2.0 million parameters, trained on the camera world's training places, with decoys.

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

    def zoo_name(self) -> str:
        return "fcos"

    def load(self, seed: int, facts: Facts) -> FCOSNetwork:
        """The zoo's detector, the same for any seed."""
        return yolo.frozen(zoo.load(zoo.Recipe.of(self), self.trained, FCOSNetwork))

    def begun(self, names: tuple[str, ...]) -> FCOSNetwork:
        return FCOSNetwork(names)

    def loss(self, network: FCOSNetwork, example: Example) -> Tensor:
        return loss(network.raw(example.pictures), example.boxes, example.labels)
