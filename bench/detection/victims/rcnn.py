"""A two-stage detector: a first stage proposes places of objects, a second one looks at each place and names the object.

The probability of a class is that of an object (first stage) times that of the class given an object (second stage), as in
Zhou, Koltun and Kraehenbuehl 2021, "Probabilistic two-stage detection" (arXiv 2103.07461, Eq. 1 and 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from cavbench import zoo
from cavbench.core.contracts import Facts
from cavbench.core.ranges import Count
from cavbench.detection import Detector, Predictions
from cavbench.detection.boxes import overlap
from cavbench.detection.victims import fcos, yolo
from cavbench.detection.victims.examples import Example
from cavbench.detection.victims.fcos import GROUPS, PYRAMID, WIDTHS, FCOSNetwork, Raw
from cavbench.detection.victims.learner import Learner
from cavbench.detection.victims.loss import complete_overlap

PROPOSALS = 200
"""Places in an image that the second stage looks at."""
LEARNT, LEARNT_OBJECTS = 48, 16
"""Places in a window that the second stage learns from, and the most of them with an object."""
SAME = 0.5
"""Smallest IoU of a place with the object in it."""
CROP = 14
"""Samples of the features along each side of a place."""
MARGIN = 1.2
"""The second stage looks at a place this many times wider and higher than the proposal."""
MAPS = ((4, WIDTHS[1]), (fcos.STRIDES[0], PYRAMID))
"""Stride and channels of the features that the second stage sees: the stem's, and the finest of the pyramid."""
HIDDEN = 64
LIMIT = 2.0
"""Most that a side of a box grows or shrinks in the second stage, as a logarithm."""


def crop(features: Sequence[Tensor], boxes: Tensor) -> Tensor:
    """The features in boxes, [N * K, channels, CROP, CROP], by bilinear sampling (RoIAlign, He et al. 2017, one sample a bin).

    Args:
        features: one [N, c, h, w] for each of `MAPS`.
        boxes: [N, K, 4] in pixels of the image.
    """
    steps = (torch.arange(CROP).to(boxes) + 0.5) / CROP
    low, size = boxes[..., :2], boxes[..., 2:] - boxes[..., :2]
    x, y = (low[..., axis, None] + size[..., axis, None] * steps for axis in (0, 1))
    shape = (*boxes.shape[:2], CROP, CROP)
    at = torch.stack((x.unsqueeze(-2).expand(shape), y.unsqueeze(-1).expand(shape)), -1).flatten(1, 2)
    parts = []
    for feature, (stride, _) in zip(features, MAPS, strict=True):
        height, width = feature.shape[2:]
        grid = 2 * at / (stride * at.new_tensor([width, height])) - 1
        seen = functional.grid_sample(feature, grid, padding_mode="border", align_corners=False)
        parts.append(seen.unflatten(2, (boxes.shape[1], CROP)).transpose(1, 2).flatten(0, 1))
    return torch.cat(parts, 1)


class Second(nn.Module):
    """The second stage: names what is in a place, and moves the box.

    Args:
        classes: number of classes.
    """

    def __init__(self, classes: int) -> None:
        super().__init__()
        inputs = sum(channels for _, channels in MAPS)
        self.look = nn.Sequential(
            *(nn.Conv2d(inputs, HIDDEN, 3, 2, padding=1), nn.GroupNorm(GROUPS, HIDDEN), nn.ReLU()),
            *(nn.Conv2d(HIDDEN, HIDDEN, 3, padding=1), nn.GroupNorm(GROUPS, HIDDEN), nn.ReLU()),
            *(nn.Flatten(), nn.Linear(HIDDEN * (CROP // 2) ** 2, 2 * HIDDEN), nn.ReLU()),
        )
        self.name = nn.Linear(2 * HIDDEN, classes + 1)
        self.move = nn.Linear(2 * HIDDEN, 4)
        nn.init.zeros_(self.move.weight)
        nn.init.zeros_(self.move.bias)

    def forward(self, features: Sequence[Tensor], places: Tensor) -> tuple[Tensor, Tensor]:
        """Logits [N, K, C + 1] of the classes and of no object, and boxes [N, K, 4], for places [N, K, 4] in pixels."""
        middle, size = (places[..., :2] + places[..., 2:]) / 2, places[..., 2:] - places[..., :2]
        seen = self.look(crop(features, torch.cat((middle - MARGIN * size / 2, middle + MARGIN * size / 2), -1)))
        logits, moved = (part.unflatten(0, places.shape[:2]) for part in (self.name(seen), self.move(seen)))
        # The parametrisation of boxes of Ren et al. 2015 (Faster R-CNN, Eq. 2).
        middle = middle + moved[..., :2] * size
        size = size * moved[..., 2:].clamp(-LIMIT, LIMIT).exp()
        return logits, torch.cat((middle - size / 2, middle + size / 2), -1)


@dataclass(frozen=True)
class Seen:
    """Output of the first stage: its raw outputs, and the features [N, c, h, w] of `MAPS`."""

    raw: Raw
    features: tuple[Tensor, ...]

    @property
    def objectness(self) -> Tensor:
        """[N, P] probability of an object at each cell: the geometric mean of score and centre-ness, as FCOS ranks its boxes."""
        return (self.raw.classes[..., 0].sigmoid() * self.raw.centreness.sigmoid()).sqrt()


class RCNNNetwork(Detector):
    """The network: an FCOS with the only class "object", and the second stage on its features.

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
        self.second = Second(len(names))

    def propose(self, pictures: Tensor) -> Seen:
        """The first stage on images [N, 3, H, W]."""
        stem = self.first.stem(pictures)
        levels = self.first.levels(stem)
        return Seen(self.first.at_cells(levels), (stem, levels[0]))

    def predict(self, pictures: Tensor) -> Predictions:
        seen = self.propose(pictures)
        sure, best = seen.objectness.topk(min(PROPOSALS, seen.objectness.shape[1]), 1)
        places = seen.raw.boxes.detach().gather(1, best.unsqueeze(-1).expand(-1, -1, 4))
        logits, boxes = self.second(seen.features, places)
        return Predictions(boxes, sure, logits.softmax(-1)[..., :-1])


def loss(network: RCNNNetwork, example: Example) -> Tensor:
    """The loss of both stages: FCOS's with the class "object", cross-entropy of the names, and complete IoU of the boxes."""
    seen = network.propose(example.pictures)
    first = fcos.loss(seen.raw, example.boxes, [torch.zeros_like(label) for label in example.labels])
    places, names, targets = learnt(seen, example, len(network.names))
    logits, boxes = network.second(seen.features, places)
    there = names < len(network.names)
    naming = functional.cross_entropy(logits.flatten(0, 1), names.flatten())
    apart = (1 - complete_overlap(boxes[there], targets[there])).sum() / there.sum().clamp(min=1)
    return first + naming + apart


@torch.no_grad()
def learnt(seen: Seen, example: Example, nothing: int) -> tuple[Tensor, Tensor, Tensor]:
    """The places that the second stage learns from: the true objects, and the first stage's best proposals of each kind.

    The number of objects is limited so that most places have none, as in Faster R-CNN; these are then the surest false proposals.

    Returns:
        [N, `LEARNT`, 4] places in pixels, [N, `LEARNT`] what is there (a label, or `nothing`), and [N, `LEARNT`, 4] its true box.
    """
    parts = []
    for boxes, scores, box, label in zip(seen.raw.boxes, seen.objectness, example.boxes, example.labels, strict=True):
        place = torch.cat((box, boxes[scores.topk(min(2 * PROPOSALS, len(scores))).indices]))
        if len(box):
            best, owner = overlap(place.unsqueeze(1), box).max(1)
            name, target = label[owner].where(best >= SAME, nothing), box[owner]
        else:
            name, target = torch.full((len(place),), nothing), place
        objects, others = ((name != nothing) == kind for kind in (True, False))
        mine = objects.nonzero().flatten()[:LEARNT_OBJECTS]
        rest = others.nonzero().flatten()[: LEARNT - len(mine)]
        chosen = torch.cat((mine, rest))
        chosen = chosen[torch.arange(LEARNT) % len(chosen)]
        parts.append((place[chosen], name[chosen], target[chosen]))
    places, names, targets = zip(*parts, strict=True)
    return torch.stack(places), torch.stack(names), torch.stack(targets)


@dataclass(frozen=True, kw_only=True)
class RCNN(Learner[RCNNNetwork]):
    """A two-stage detector of 2.5 million parameters, trained on the camera world's training places, with decoys.

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

    updates: Count = 1600

    def zoo_name(self) -> str:
        return "rcnn"

    def load(self, seed: int, facts: Facts) -> RCNNNetwork:
        """The zoo's detector, the same for any seed."""
        return yolo.frozen(zoo.load(zoo.Recipe.of(self), self.trained, RCNNNetwork))

    def begun(self, names: tuple[str, ...]) -> RCNNNetwork:
        return RCNNNetwork(names)

    def loss(self, network: RCNNNetwork, example: Example) -> Tensor:
        return loss(network, example)
