"""Post-processing of a detector's predictions: non-maximum suppression, and the confidence in one object."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cavbench.detection.detector import Detections, Predictions

MOST = 100
"""Most detections of an image."""


def overlap(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union of boxes [..., 4] and [..., 4], broadcast, in [0, 1]; 0 if neither has an area."""
    low, high = torch.maximum(a[..., :2], b[..., :2]), torch.minimum(a[..., 2:], b[..., 2:])
    intersection = (high - low).clamp(min=0).prod(-1)
    union = _area(a) + _area(b) - intersection
    return intersection / union.clamp(min=torch.finfo(union.dtype).tiny)


def _area(boxes: Tensor) -> Tensor:
    return (boxes[..., 2:] - boxes[..., :2]).prod(-1)


@torch.no_grad()
def detections(predictions: Predictions, *, threshold: float, iou: float) -> list[Detections]:
    """The objects in each image, after greedy non-maximum suppression within each class.

    A box can have more than one class. Only the `MOST` best of an image are kept, as in the evaluation of COCO.

    Args:
        predictions: predictions on N images.
        threshold: scores must be above it, in [0, 1].
        iou: a box is dropped if it overlaps a better box of its class by more than this, in [0, 1].
    """
    return [
        _suppressed(boxes, scores, threshold, iou)
        for boxes, scores in zip(predictions.boxes, predictions.scores, strict=True)
    ]


def _suppressed(boxes: Tensor, scores: Tensor, threshold: float, iou: float) -> Detections:
    """`detections` for one image: boxes [K, 4], scores [K, C]."""
    place, labels = (scores > threshold).nonzero(as_tuple=True)
    order = scores[place, labels].argsort(descending=True, stable=True)
    place, labels = place[order], labels[order]
    kept: list[Tensor] = []
    left = torch.arange(len(place), device=boxes.device)
    while len(left) and len(kept) < MOST:
        best, left = left[0], left[1:]
        kept.append(best)
        covered = overlap(boxes[place[best]], boxes[place[left]]) > iou
        left = left[~covered | (labels[left] != labels[best])]
    chosen = torch.stack(kept) if kept else left
    place, labels = place[chosen], labels[chosen]
    return Detections(boxes[place], scores[place, labels], labels)


@torch.no_grad()
def confidence(predictions: Predictions, label: int, boxes: Tensor, *, iou: float = 0.3) -> Tensor:
    """The best score [N] of a class at the object's true place; 0 if there is no prediction.

    The default of `iou` allows a box to be shifted by half its width: an attack must hide the sign, not shift its box.
    YOLOv3-tiny's boxes of a clean stop sign have an IoU of at least 0.75.

    Args:
        predictions: predictions on N images.
        label: label of the class.
        boxes: [N, 4], the true box in each image.
        iou: smallest IoU with the true box at which a prediction counts.
    """
    matches = overlap(predictions.boxes, boxes.unsqueeze(1)) >= iou
    scores = predictions.scores_of(label) * matches
    return nn.functional.pad(scores, (0, 1)).amax(-1)


@torch.no_grad()
def best_other(predictions: Predictions, label: int, boxes: Tensor, *, iou: float = 0.3) -> list[tuple[float, int]]:
    """The best score of any other class at the object's true place in each image, and that class; 0 and `label` if there is none.

    Args:
        predictions: predictions on N images.
        label: label of the object's class.
        boxes: [N, 4], the true box in each image.
        iou: smallest IoU with the true box at which a prediction counts.
    """
    found = []
    for number, box in enumerate(boxes):
        here = overlap(predictions.boxes[number], box) >= iou
        scores = predictions.objectness[number, here, None] * predictions.classes[number, here]
        best = nn.functional.pad(scores, (0, 0, 0, 1)).amax(0)
        best[label] = 0
        score, other = best.max(0)
        found.append((float(score), int(other) if score > 0 else label))
    return found
