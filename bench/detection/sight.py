"""The output of a detector on the frames of an approach, with the stop sign or with decoys in its place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.detection import stopping
from cavbench.detection.boxes import best_other, confidence, detections
from cavbench.detection.detector import STOP_SIGN, Detections, Detector, Predictions
from cavbench.detection.scenes import Scenes
from cavbench.errors import UserError
from cavbench.isolation.modes import kept

BATCH = 16
"""Frames per forward pass."""
NMS_IOU, SAME_IOU = 0.45, 0.3
"""IoU of non-maximum suppression (YOLOv5's default), and smallest IoU at which a detection is the sign (`boxes.confidence`)."""
LEAST_SCORE = 0.01
"""Detections with a lower score are not kept; average precision does not see them."""


@dataclass(frozen=True)
class Sight:
    """The output of a detector on the F frames of an approach.

    Args:
        confidence: float32 [F], confidence in a stop sign at the place of the sign, in [0, 1]; 0 without a box there.
        candidates: the stop signs with a score above `LEAST_SCORE` in each frame, after non-maximum suppression.
        others: the class other than a stop sign with the highest score at the place of the sign in each frame; empty if that
            is no higher than the confidence, or no detection.
        alone: the confidence in each frame by itself, without what is remembered of others; None if it is the same.
    """

    confidence: NDArray[np.float32]
    candidates: Sequence[Detections]
    others: Sequence[str]
    alone: NDArray[np.float32] | None = None

    @property
    def by_frame(self) -> NDArray[np.float32]:
        """[F] the confidence in each frame by itself."""
        return self.confidence if self.alone is None else self.alone

    @property
    def found(self) -> Sequence[Detections]:
        """The stop signs detected in each frame: the candidates above the threshold of detection."""
        return [surer(one, stopping.THRESHOLD) for one in self.candidates]


def surer(found: Detections, threshold: float) -> Detections:
    """The detections with a score above a threshold."""
    kept = found.scores > threshold
    return Detections(found.boxes[kept], found.scores[kept], found.labels[kept])


def look(detector: Detector, scenes: Scenes, texels: Tensor | None, share: float) -> Sight:
    """Run the detector on each frame.

    Args:
        detector: the (defended) victim.
        scenes: F frames.
        texels: the patch [3, P, P]; None for no patch.
        share: side of the patch as a share of the sign's side.

    Raises:
        UserError: if a prediction is NaN, infinite or complex.
    """
    patches = texels.unsqueeze(0) if texels is not None else None
    return _sight(detector, scenes, lambda frames: scenes.render(frames, patches, share))


def look_at_decoys(detector: Detector, scenes: Scenes) -> Sight | None:
    """Run the detector on each frame with the frame's decoy in the place of the stop sign; None if the world has none.

    Raises:
        UserError: if a prediction is NaN, infinite or complex.
    """
    return _sight(detector, scenes, scenes.render_decoys) if scenes.decoys else None


def look_at_faces(detector: Detector, scenes: Scenes) -> Sight | None:
    """Run the detector on each frame with a face that no training sees in the place of the sign; None if the world has none.

    Raises:
        UserError: if a prediction is NaN, infinite or complex.
    """
    return look_at_decoys(detector, scenes.with_decoys(scenes.faces)) if scenes.faces else None


def certain(detector: Detector, scenes: Scenes, share: float) -> NDArray[np.float32] | None:
    """[F] what the detector reports at least of the sign in each frame, whatever is on the patch; None without a certificate.

    Args:
        detector: the (defended) victim.
        scenes: F frames.
        share: side of the patch as a share of the sign's side.
    """
    if type(detector).certified is Detector.certified:
        return None  # No frame is rendered for a detector without a certificate.
    reach, parts = scenes.reach(share), []
    for frames in torch.arange(len(scenes)).split(BATCH):
        shown = scenes.render(frames, None, share)
        with kept("defense"):
            part = detector.certified(shown, scenes.boxes[frames], reach[frames])
        if part is None:
            return None
        parts.append(part.numpy())
    return np.concatenate(parts)


def _sight(detector: Detector, scenes: Scenes, render: Callable[[Tensor], Tensor]) -> Sight:
    moved = -torch.diff(scenes.distance, prepend=scenes.distance[:1])
    parts, state = [], detector.initial()
    for frames in torch.arange(len(scenes)).split(BATCH):
        part, state = glance(detector, render(frames), scenes.boxes[frames], moved[frames], state)
        parts.append(part)
    return Sight(
        np.concatenate([part.confidence for part in parts]),
        [one for part in parts for one in part.candidates],
        [one for part in parts for one in part.others],
        np.concatenate([part.by_frame for part in parts]),
    )


def glance(detector: Detector, pictures: Tensor, boxes: Tensor, moved_m: Tensor, state: Any) -> tuple[Sight, Any]:
    """Run the detector on the next frames of an approach, and return what it remembers after them.

    Args:
        detector: the (defended) victim.
        pictures: images [N, 3, H, W] in driving order.
        boxes: [N, 4], the true box of the sign in each.
        moved_m: [N], as in `Detector.advance`.
        state: what the detector remembers of the frames before.

    Raises:
        UserError: if a prediction is NaN, infinite or complex.
    """
    label = detector.index(STOP_SIGN)
    with kept("defense"):
        alone = _finite(detector(pictures), detector)
        predictions, state = detector.advance(alone, moved_m, state)
    if predictions is not alone:
        _finite(predictions, detector)
    boxes = boxes.to(predictions.boxes)
    sure = confidence(predictions, label, boxes, iou=SAME_IOU)
    by_frame = sure if predictions is alone else confidence(alone, label, boxes, iou=SAME_IOU)
    others = [
        detector.names[found] if score > max(float(of_sign), stopping.THRESHOLD) else ""
        for (score, found), of_sign in zip(best_other(predictions, label, boxes, iou=SAME_IOU), sure, strict=True)
    ]
    return Sight(sure.numpy(), candidates_of(predictions, label), others, by_frame.numpy()), state


def _finite(predictions: Predictions, detector: Detector) -> Predictions:
    parts = (predictions.boxes, predictions.objectness, predictions.classes)
    if all(bool(part.isfinite().all()) and not part.is_complex() for part in parts):
        return predictions
    raise UserError(f"the victim ({type(detector).__name__}) answered NaN, infinite or complex boxes or scores")


def candidates_of(predictions: Predictions, label: int) -> list[Detections]:
    """The objects of one class in each image with a score above `LEAST_SCORE`, after non-maximum suppression."""
    only = replace(predictions, classes=predictions.classes[..., label : label + 1])
    return detections(only, threshold=LEAST_SCORE, iou=NMS_IOU)
