"""Average precision of the class "stop sign" over frames with the sign and frames with a decoy in its place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from cavbench.detection.boxes import overlap
from cavbench.detection.detector import Detections

MATCH_IOU = 0.5
"""Smallest IoU with the true box at which a detection counts as true (PASCAL VOC, Everingham et al. 2010, section 4.2)."""
VISIBLE = 0.5
"""Signs that show a smaller share are difficult: neither to find them nor to miss them counts (the same, section 3.2)."""


def average_precision(scores: NDArray[np.floating], true: NDArray[np.bool_], signs: int) -> float:
    """Area under the precision-recall curve, sum_n (R_n - R_(n-1)) P_n over the distinct scores, without interpolation.

    Args:
        scores: [D] of all detections in some images; those with equal scores are one step.
        true: [D] whether each detection is a sign, at most one a sign.
        signs: number of signs in the images.

    Returns:
        In [0, 1]; NaN if there is no sign.
    """
    if not signs:
        return np.nan
    order = np.argsort(-scores, kind="stable")
    last = np.append(np.diff(scores[order]) != 0, True)[: len(scores)]
    hits, found = np.cumsum(true[order])[last], (np.arange(len(scores)) + 1)[last]
    return float((np.diff(hits / signs, prepend=0.0) * (hits / found)).sum())


def precision_of_approach(
    real: Sequence[Detections], decoys: Sequence[Detections], boxes: Tensor, visible: Tensor
) -> float:
    """`average_precision` of the stop signs detected in the F frames of an approach, with the sign and with decoys.

    Args:
        real: the detections in each frame, best first.
        decoys: the same where the post carries a decoy; all of them are false.
        boxes: [F, 4] true boxes of the sign.
        visible: [F] visible share of the sign; a detection of one below `VISIBLE` is left out.
    """
    scores, true, signs = [one.scores.numpy() for one in decoys], [np.zeros(len(one.scores), bool) for one in decoys], 0
    for one, box, share in zip(real, boxes, visible.tolist(), strict=True):
        on_sign = (overlap(one.boxes, box) >= MATCH_IOU).numpy()
        counted = np.ones(len(on_sign), bool) if share >= VISIBLE else ~on_sign
        # Of several boxes on a sign, the best is true.
        first = on_sign & (np.cumsum(on_sign) == 1) & counted
        scores.append(one.scores.numpy()[counted])
        true.append(first[counted])
        signs += share >= VISIBLE
    return average_precision(np.concatenate(scores), np.concatenate(true), signs)
