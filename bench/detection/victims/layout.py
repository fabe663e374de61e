"""The outputs of detectors of others: which of them are boxes, scores and labels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from cavbench.detection.victims import coco
from cavbench.errors import UserError

Layout = Literal[
    "boxes and scores", "scores and boxes", "objectness", "rows", "columns", "labelled", "apart", "counted"
]
"""Two outputs; or one: a row [box, objectness, scores] (YOLOv5), [box, scores] (RT-DETR) or [box, score, label] (YOLOv10) for
each prediction, or a column [box, scores] (YOLOv8); or boxes, scores and labels apart in any order (RT-DETR, torchvision),
with the number of predictions as a fourth (TensorFlow)."""
Activation = Literal["none", "sigmoid", "softmax"]
CORNERS: tuple[Layout, ...] = ("boxes and scores", "scores and boxes", "labelled", "apart", "counted")
"""Layouts whose boxes are corners unless the user says otherwise, of `counted` with y first; the others' have centre and size."""
SORTED: tuple[Layout, ...] = ("labelled", "apart", "counted")
"""Layouts whose predictions are the best ones with a label each."""


def allowed(count: int) -> str:
    """The allowed outputs of a detector with `count` classes."""
    return (
        f"boxes [N, K, 4] and scores [N, K, {count}], or one output [N, K, {5 + count}], [N, K, {4 + count}], "
        f"[N, {4 + count}, K] or [N, K, 6], or boxes [N, K, 4], scores [N, K] and labels [N, K]"
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
        case [_, _, _] | [_, _, _, _] as found:
            return _apart(found)
        case _:
            return None


def _paired(boxes: tuple[int, ...], scores: tuple[int, ...], count: int) -> bool:
    alike = len(boxes) == 3 and boxes[2] == 4 and scores[:2] == boxes[:2]
    return alike and (scores[2:] == (count,) or (len(scores) == 2 and count == 1))


def _apart(shapes: Sequence[tuple[int, ...]]) -> Layout | None:
    """Boxes [N, K, 4] with two outputs [N, K], and perhaps a number [N] or [N, 1]."""
    boxes = [shape for shape in shapes if len(shape) == 3 and shape[2] == 4]
    if len(boxes) != 1:
        return None
    flat = [shape for shape in shapes if shape == boxes[0][:2]]
    rest = [shape for shape in shapes if shape not in (boxes[0], boxes[0][:2])]
    counted = [shape for shape in rest if shape in (boxes[0][:1], (boxes[0][0], 1))]
    if len(flat) != 2 or len(counted) != len(rest):
        return None
    return "counted" if rest else "apart"


def named(shapes: Sequence[Sequence[int]]) -> tuple[str, ...]:
    """COCO's class names in the numbering that outputs with these shapes fit: that of 80 classes if none does, or if any may."""
    for names in coco.NUMBERINGS.values():
        if layout_of(shapes, len(names)):
            return names
    return coco.NAMES


def with_no_object(names: tuple[str, ...], shapes: Sequence[Sequence[int]]) -> tuple[str, ...]:
    """Class names, with "no object" at the end if outputs with these shapes have one class more, as DETR's have."""
    more = not layout_of(shapes, len(names)) and layout_of(shapes, len(names) + 1) in (
        "boxes and scores",
        "scores and boxes",
    )
    return (*names, coco.NO_OBJECT) if more else names


def split(
    outputs: Sequence[Tensor], layout: Layout, count: int, activation: Activation = "none"
) -> tuple[Tensor, Tensor, Tensor]:
    """Boxes [N, K, 4] as in the file, objectness [N, K] and class scores [N, K, C] of outputs in a layout.

    Args:
        outputs: the outputs.
        layout: their layout.
        count: C, the number of classes.
        activation: makes probabilities of objectness and scores; a softmax is over the classes.

    Raises:
        UserError: if labels cannot be told from scores.
    """
    if layout in SORTED:
        boxes, sure, label = _best(outputs, layout)
        # A label that is none of a class, NaN included, counts for no class.
        one_hot = label.unsqueeze(-1).round() == torch.arange(count, device=label.device)
        return boxes, sure.sigmoid() if activation == "sigmoid" else sure, one_hot.to(sure.dtype)
    if layout in ("boxes and scores", "scores and boxes"):
        boxes, scores = outputs if layout == "boxes and scores" else reversed(outputs)
        scores = scores.reshape(*boxes.shape[:2], count)
    else:
        (rows,) = outputs
        rows = rows.transpose(1, 2) if layout == "columns" else rows
        boxes, scores = rows[..., :4], rows[..., 4:]
    objectness = scores[..., 0] if layout == "objectness" else None
    scores = scores[..., 1:] if layout == "objectness" else scores
    if activation == "sigmoid":
        objectness, scores = None if objectness is None else objectness.sigmoid(), scores.sigmoid()
    elif activation == "softmax":
        scores = scores.softmax(-1)
    return boxes, torch.ones_like(scores[..., 0]) if objectness is None else objectness, scores


def _best(outputs: Sequence[Tensor], layout: Layout) -> tuple[Tensor, Tensor, Tensor]:
    """Boxes [N, K, 4], scores [N, K] and labels [N, K]; scores beyond the number of predictions are 0."""
    if layout == "labelled":
        (rows,) = outputs
        return rows[..., :4], rows[..., 4], rows[..., 5]
    (boxes,) = (one for one in outputs if one.ndim == 3)
    scores, labels = _told_apart(*(one for one in outputs if one.shape == boxes.shape[:2]))
    if layout == "counted":
        (number,) = (one for one in outputs if one.shape not in (boxes.shape, boxes.shape[:2]))
        there = torch.arange(boxes.shape[1], device=boxes.device) < number.reshape(-1, 1)
        scores = scores * there.to(scores.dtype)
    return boxes, scores, labels


def _told_apart(one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    """Scores, and labels: those that are whole numbers.

    Raises:
        UserError: if neither are.
    """
    whole = [not part.is_floating_point() or bool((part == part.round()).all()) for part in (one, other)]
    if whole == [False, False]:
        raise UserError("neither of the two outputs [N, K] is labels, which are whole numbers")
    typed = [not part.is_floating_point() for part in (one, other)]
    if typed[0] != typed[1]:
        first = typed[0]
    elif whole[0] != whole[1]:
        first = whole[0]
    else:
        # Scores that are all 0 or 1 are whole numbers, too, but the smaller ones.
        first = bool(one.max() > other.max())
    scores, labels = (other, one) if first else (one, other)
    return scores.float(), labels.float()
