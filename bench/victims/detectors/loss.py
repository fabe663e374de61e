"""What a detector is trained by, said of its predictions alone: it fits every detector, whatever its heads and anchors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from bench.detection import Predictions
from bench.detection.boxes import overlap

ASSIGNED = 10
"""Predictions that answer for an object."""
BOX_WEIGHT = 5.0


def supervised(predictions: Predictions, boxes: Sequence[Tensor], labels: Sequence[Tensor]) -> Tensor:
    """The loss of a detector that learns from labelled pictures, by task-aligned assignment (Feng et al. 2021, "TOOD").

    An object is answered for by the `ASSIGNED` predictions of the largest s^0.5 u^3 whose centre is within it, s their score and
    u their overlap with it. Their objectness is to be u, relative to the best of them, their class the object's, their box its
    box; of all others the objectness is to be 0.

    Args:
        predictions: of N pictures.
        boxes: [K_n, 4] of each picture, in pixels.
        labels: int64 [K_n] of each picture.
    """
    wanted = torch.zeros_like(predictions.objectness)
    classes, places = predictions.objectness.new_zeros(()), predictions.objectness.new_zeros(())
    for number, (box, label) in enumerate(zip(boxes, labels, strict=True)):
        if not len(box):
            continue
        here, probability = predictions.boxes[number], predictions.classes[number]
        target, owner = _assigned(
            here.detach(), (predictions.objectness[number, :, None] * probability).detach(), box, label
        )
        mine = target > 0
        wanted[number] = target
        weight, own = target[mine], owner[mine]
        truth = torch.nn.functional.one_hot(label[own], probability.shape[-1]).to(probability)
        each = torch.nn.functional.binary_cross_entropy(probability[mine], truth, reduction="none").sum(-1)
        classes = classes + (each * weight).sum()
        places = places + ((1 - complete_overlap(here[mine], box[own])) * weight).sum()
    objectness = torch.nn.functional.binary_cross_entropy(predictions.objectness, wanted, reduction="sum")
    return (objectness + classes + BOX_WEIGHT * places) / wanted.sum().clamp(min=1.0)


def _assigned(here: Tensor, scores: Tensor, boxes: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Of one picture: [P] the objectness each prediction [P, 4] should have, and [P] which object it answers for."""
    shared = overlap(boxes[:, None], here)
    centre = (here[:, :2] + here[:, 2:]) / 2
    within = ((centre > boxes[:, None, :2]) & (centre < boxes[:, None, 2:])).all(-1)
    fit = scores[:, labels].T.sqrt() * shared**3 * within
    best = fit.topk(min(ASSIGNED, fit.shape[1]), 1)
    chosen = torch.zeros_like(fit).scatter(1, best.indices, best.values)
    most = shared.where(chosen > 0, 0).amax(1, keepdim=True)
    relative = chosen / chosen.amax(1, keepdim=True).clamp(min=torch.finfo(fit.dtype).tiny)
    target, owner = (relative * most).max(0)
    return target, owner


def complete_overlap(a: Tensor, b: Tensor) -> Tensor:
    """[M] the overlap of boxes [M, 4], less what their centres and shapes differ by (Zheng et al. 2020, CIoU, Eq. 5 to 7)."""
    low, high = torch.minimum(a[:, :2], b[:, :2]), torch.maximum(a[:, 2:], b[:, 2:])
    diagonal = (high - low).square().sum(-1).clamp(min=1e-6)
    apart = ((a[:, :2] + a[:, 2:] - b[:, :2] - b[:, 2:]) / 2).square().sum(-1)
    (aw, ah), (bw, bh) = ((box[:, 2:] - box[:, :2]).clamp(min=1e-6).unbind(-1) for box in (a, b))
    shape = 4 / torch.pi**2 * (torch.atan(aw / ah) - torch.atan(bw / bh)).square()
    shared = overlap(a, b)
    with torch.no_grad():
        alpha = shape / (1 - shared + shape).clamp(min=1e-6)
    return shared - apart / diagonal - alpha * shape


def unlike(predictions: Predictions, teacher: Predictions) -> Tensor:
    """How far predictions are from a teacher's of as many pictures: cross-entropies above the teacher's own entropy, and boxes.

    Classes and boxes count by the teacher's objectness; a sum over predictions, a mean over pictures.
    """

    def entropy(of: Tensor, wanted: Tensor) -> Tensor:
        return torch.nn.functional.binary_cross_entropy(of, wanted, reduction="none")

    sure = teacher.objectness
    there = entropy(predictions.objectness, sure) - entropy(sure, sure)
    named = (entropy(predictions.classes, teacher.classes) - entropy(teacher.classes, teacher.classes)).sum(-1)
    moved = 1 - overlap(predictions.boxes, teacher.boxes)
    return (there + sure * (named + moved)).sum(1).mean()


def missed(predictions: Predictions, label: int, boxes: Tensor, *, iou: float = 0.5) -> Tensor:
    """[N] minus the logarithm of the best score of a class at the true box [N, 4] of each picture."""
    there = overlap(predictions.boxes, boxes.unsqueeze(1)) >= iou
    return -(predictions.scores_of(label) * there).amax(1).clamp(min=1e-4).log()
