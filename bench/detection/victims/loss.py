"""Training losses on the predictions of a detector, independent of its heads and anchors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cavbench.detection import Predictions
from cavbench.detection.boxes import overlap

ASSIGNED = 10
"""Number of predictions assigned to an object."""
BOX_WEIGHT = 5.0


def supervised(predictions: Predictions, boxes: Sequence[Tensor], labels: Sequence[Tensor]) -> Tensor:
    """The supervised loss on labelled images, with task-aligned assignment (Feng et al. 2021, "TOOD").

    Each object is assigned the `ASSIGNED` predictions with the largest s^0.5 u^3 and a centre within its box, where s is the
    score and u the IoU with the object. Their targets are the object's box, its class, and an objectness of s^0.5 u^3, scaled so
    that the largest is the best u. The objectness target of all other predictions is 0.

    Args:
        predictions: predictions on N images.
        boxes: [K_n, 4] true boxes of each image, in pixels.
        labels: int64 [K_n] true labels of each image.
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
    """For one image: [P] target objectness of each prediction [P, 4], and [P] index of the object it is assigned to."""
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
    """[M] complete IoU of boxes [M, 4]: IoU minus penalties for distance and aspect ratio (Zheng et al. 2020, Eq. 5 to 7)."""
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
    """[N] distillation loss: cross-entropy with a teacher's predictions, minus the teacher's entropy, and box distance (1 - IoU).

    Classes and boxes are weighted by the teacher's objectness. A sum over predictions.
    """

    def entropy(output: Tensor, target: Tensor) -> Tensor:
        return torch.nn.functional.binary_cross_entropy(output, target, reduction="none")

    weight = teacher.objectness
    objectness = entropy(predictions.objectness, weight) - entropy(weight, weight)
    classes = (entropy(predictions.classes, teacher.classes) - entropy(teacher.classes, teacher.classes)).sum(-1)
    boxes = 1 - overlap(predictions.boxes, teacher.boxes)
    return (objectness + weight * (classes + boxes)).sum(1)


def mistaken(predictions: Predictions, label: int, boxes: Tensor, there: Tensor) -> Tensor:
    """[N] negative logarithm of 1 minus the best score of a class away from its only object in each image.

    Args:
        predictions: predictions on N images.
        label: the class.
        boxes: [N, 4] box of the object.
        there: bool [N], whether the object is in the image; if not, every prediction is away from it.
    """
    away = (overlap(predictions.boxes, boxes.unsqueeze(1)) == 0) | ~there.unsqueeze(1)
    return -(1 - (predictions.scores_of(label) * away).amax(1)).clamp(min=1e-4).log()


def missed(predictions: Predictions, label: int, boxes: Tensor, *, iou: float = 0.5) -> Tensor:
    """[N] negative logarithm of the best score of a class at the true box [N, 4] of each image."""
    matches = overlap(predictions.boxes, boxes.unsqueeze(1)) >= iou
    return -(predictions.scores_of(label) * matches).amax(1).clamp(min=1e-4).log()
