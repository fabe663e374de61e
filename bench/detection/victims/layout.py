"""The outputs of detectors in files: which of them are boxes, and which are scores."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

Layout = Literal["boxes and scores", "scores and boxes", "objectness", "rows", "columns", "labelled"]
"""Two outputs; or one: a row [box, objectness, scores] (YOLOv5), [box, scores] (RT-DETR) or [box, score, label] (YOLOv10) for
each prediction, or a column [box, scores] (YOLOv8)."""
CORNERS: tuple[Layout, ...] = ("boxes and scores", "scores and boxes", "labelled")
"""Layouts whose boxes are [x1, y1, x2, y2] unless the user says otherwise; those of the others are [x, y, width, height]."""


def allowed(count: int) -> str:
    """The allowed outputs of a detector with `count` classes."""
    return (
        f"boxes [N, K, 4] and scores [N, K, {count}], or one output [N, K, {5 + count}], [N, K, {4 + count}], "
        f"[N, {4 + count}, K] or [N, K, 6]"
    )


def layout_of(shapes: Sequence[Sequence[int]], count: int) -> Layout | None:
    """The layout of outputs with these shapes, from a detector with `count` classes; None if it is not allowed."""
    match [tuple(shape) for shape in shapes]:
        case [boxes, scores] if _paired(boxes, scores, count):
            return "boxes and scores"
        case [scores, boxes] if _paired(boxes, scores, count):
            return "scores and boxes"
        case [(_, middle, last)] if middle == 4 + count and last in (4 + count, 5 + count, 6):
            # Rows and columns are equally long.
            return None
        case [(_, _, last)] if last == 5 + count:
            return "objectness"
        case [(_, _, last)] if last == 4 + count:
            return "rows"
        case [(_, middle, _)] if middle == 4 + count:
            return "columns"
        case [(_, _, 6)]:
            return "labelled"
        case _:
            return None


def _paired(boxes: tuple[int, ...], scores: tuple[int, ...], count: int) -> bool:
    alike = len(boxes) == 3 and boxes[2] == 4 and scores[:2] == boxes[:2]
    return alike and (scores[2:] == (count,) or (len(scores) == 2 and count == 1))


def split(outputs: Sequence[Tensor], layout: Layout, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Boxes [N, K, 4] as in the file, objectness [N, K] and class scores [N, K, C] of outputs in a layout."""
    if layout in ("boxes and scores", "scores and boxes"):
        boxes, scores = outputs if layout == "boxes and scores" else reversed(outputs)
        scores = scores.reshape(*boxes.shape[:2], count)
    else:
        (rows,) = outputs
        rows = rows.transpose(1, 2) if layout == "columns" else rows
        boxes, scores = rows[..., :4], rows[..., 4:]
    if layout == "objectness":
        return boxes, scores[..., 0], scores[..., 1:]
    if layout == "labelled":
        # A label that is none of a class, NaN included, counts for no class.
        one_hot = scores[..., 1:].round() == torch.arange(count, device=scores.device)
        return boxes, scores[..., 0], one_hot.to(scores.dtype)
    return boxes, torch.ones_like(scores[..., 0]), scores
