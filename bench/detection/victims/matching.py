"""The loss of a set of objects: each is matched with one prediction, the others are to find nothing (Carion et al. 2020)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torch.nn import functional

from cavbench.detection.boxes import overlap
from cavbench.detection.victims.examples import Example
from cavbench.errors import UserError

CLASS, CORNERS, SHAPE = 2.0, 5.0, 2.0
"""Weights of the three parts of the cost of a match; the last two are those of the loss (Zhu et al. 2021, section A.4)."""
ALPHA, GAMMA = 0.25, 2.0
"""Of the focal cost (Lin et al. 2017, Eq. 5)."""
NOTHING = 0.75
"""Weight of what finds nothing in the varifocal loss (Zhang et al. 2021, Eq. 2)."""
SMALLEST = 1e-6


@dataclass(frozen=True)
class Answer:
    """What K queries answer on N images: boxes [N, K, 4] in pixels, and logits [N, K, C] of the classes."""

    boxes: Tensor
    logits: Tensor


def loss(answer: Answer, example: Example, *, copies: int = 1) -> Tensor:
    """The loss of a set of objects: varifocal loss of the classes, L1 and generalised IoU of the boxes.

    A class is to be as sure as the box is right: the target is its IoU (Zhang et al. 2021, "VarifocalNet", Eq. 2).

    Args:
        answer: of K queries.
        example: windows with objects.
        copies: number of queries that each object is matched with.
    """
    side = example.pictures.shape[-1]
    wanted = torch.zeros_like(answer.logits)
    places, count = answer.boxes.new_zeros(()), 0
    for number, (box, label) in enumerate(zip(example.boxes, example.labels, strict=True)):
        here, logits = answer.boxes[number], answer.logits[number]
        queries, objects = matched(here.detach(), logits.detach(), box, label, side, copies)
        mine, own = here[queries], box[objects]
        wanted[number, queries, label[objects]] = overlap(mine.detach(), own)
        apart = CORNERS * distance(mine, own) / side + SHAPE * (1 - likeness(mine, own))
        places = places + apart.sum()
        count += len(queries)
    found = answer.logits.detach().sigmoid()
    weight = torch.where(wanted > 0, wanted, NOTHING * found**GAMMA)
    classes = functional.binary_cross_entropy_with_logits(answer.logits, wanted, weight, reduction="sum")
    return (classes + places) / max(count, 1)


@torch.no_grad()
def matched(
    here: Tensor, logits: Tensor, boxes: Tensor, labels: Tensor, side: int, copies: int
) -> tuple[Tensor, Tensor]:
    """The cheapest assignment of objects to queries of one image: M indices of each. No query has two objects.

    Args:
        here: [K, 4] boxes of the queries, in pixels.
        logits: [K, C] their classes.
        boxes: [T, 4] true boxes.
        labels: int64 [T] true labels.
        side: of the image, in pixels.
        copies: number of queries for each object.

    Raises:
        UserError: if the costs are not finite: the training has diverged.
    """
    sure = logits.sigmoid()[:, labels]
    right = ALPHA * (1 - sure) ** GAMMA * -sure.clamp(min=SMALLEST).log()
    wrong = (1 - ALPHA) * sure**GAMMA * -(1 - sure).clamp(min=SMALLEST).log()
    place, true = here.unsqueeze(1), boxes.unsqueeze(0)
    cost = CLASS * (right - wrong) + CORNERS * distance(place, true) / side - SHAPE * likeness(place, true)
    if not bool(cost.isfinite().all()):
        raise UserError(
            "the detector's boxes or classes are not finite, so its training has diverged: try a lower learning rate"
        )
    queries, objects = linear_sum_assignment(cost.repeat(1, copies).numpy())
    return torch.from_numpy(queries), torch.from_numpy(objects) % max(len(boxes), 1)


def distance(a: Tensor, b: Tensor) -> Tensor:
    """[...] L1 distance of boxes [..., 4] as middles and sizes, broadcast, in pixels."""
    low, high = (a - b).unflatten(-1, (2, 2)).unbind(-2)
    return ((low + high).abs() / 2 + (high - low).abs()).sum(-1)


def likeness(a: Tensor, b: Tensor) -> Tensor:
    """[...] generalised IoU (Rezatofighi et al. 2019) of boxes [..., 4], broadcast, in [-1, 1]."""
    low, high = torch.maximum(a[..., :2], b[..., :2]), torch.minimum(a[..., 2:], b[..., 2:])
    shared = (high - low).clamp(min=0).prod(-1)
    union = (a[..., 2:] - a[..., :2]).prod(-1) + (b[..., 2:] - b[..., :2]).prod(-1) - shared
    hull = (torch.maximum(a[..., 2:], b[..., 2:]) - torch.minimum(a[..., :2], b[..., :2])).prod(-1)
    return shared / union.clamp(min=SMALLEST) - (hull - union) / hull.clamp(min=SMALLEST)
