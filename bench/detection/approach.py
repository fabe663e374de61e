"""A defended detector on approaches to a stop sign, with a patch on the sign: what it sees, and what comes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench.detection import stopping
from bench.detection.boxes import confidence, detections, overlap
from bench.detection.detector import STOP_SIGN, Detections, Detector, Predictions
from bench.detection.patch import Patch
from bench.detection.scenes import Approach, Scenes

Columns = dict[str, NDArray[np.generic]]

BATCH = 16
"""Frames looked at at once."""
SAME_CONFIDENCE = 0.01
"""Confidences no farther apart than this are the same answer."""
NMS_IOU, SAME_IOU = 0.45, 0.3
"""Of non-maximum suppression (YOLOv5's default), and from which a detection is of the sign itself (`boxes.confidence`)."""


@dataclass(frozen=True)
class Sight:
    """What a detector says of the F frames of an approach.

    Args:
        confidence: float32 [F] in the sign at its true place, in [0, 1]; 0 where it has no box there.
        found: the stop signs that it detects in each frame.
    """

    confidence: NDArray[np.float32]
    found: Sequence[Detections]


@dataclass(frozen=True)
class Sighting:
    """An approach as it was scored, and as it would have been without the patch.

    Args:
        approach: what was driven up to.
        patch: what was on the sign; None leaves it alone.
        share: side of the patch in shares of the sign's.
        shown: what was scored.
        clean: the same without the patch; None where there is none.
    """

    approach: Approach
    patch: Patch | None
    share: float
    shown: Sight
    clean: Sight | None

    @property
    def texels(self) -> Tensor | None:
        """The patch, where there is one."""
        return self.patch.texels if self.patch else None


@dataclass(frozen=True)
class Trace:
    """A few approaches of a unit, for recordings: `sightings` has one for each of `episodes`, which count its seeds."""

    episodes: Sequence[int]
    sightings: list[Sighting] = field(default_factory=list)


def score(
    detector: Detector,
    approaches: Sequence[Approach],
    patch: Patch | None,
    *,
    share: float,
    trace: Trace | None = None,
) -> Columns:
    """Show a detector every frame of A approaches and return the measurements, [A] each.

    Args:
        detector: the (defended) victim.
        approaches: what is driven up to.
        patch: what is on the sign; None for nothing.
        share: side of the patch in shares of the sign's.
        trace: filled with what was seen on its episodes.
    """
    texels = patch.texels if patch else None
    with torch.no_grad():
        seen = [look(detector, approach.scenes, texels, share) for approach in approaches]
        if trace:
            for place in trace.episodes:
                clean = look(detector, approaches[place].scenes, None, share) if texels is not None else None
                trace.sightings.append(Sighting(approaches[place], patch, share, seen[place], clean))
    crafted = patch or Patch(texels=None)
    constant = {
        "patch_sha256": crafted.sha256,
        "queries": crafted.queries,
        "gradients": crafted.gradients,
        "crafting_s": crafted.seconds,
        "excess": crafted.excess,
        "gradient_queries": float(crafted.gradients),
        "zero_gradients": crafted.zero_gradients / crafted.gradients if crafted.gradients else np.nan,
        "draws": np.nan,
        **probed(detector, approaches[0].scenes),
    }
    return {
        "seed": np.array([approach.seed for approach in approaches], np.int64),
        "location": np.array([approach.location for approach in approaches]),
        **{name: np.array([value] * len(approaches)) for name, value in constant.items()},
        **measured(seen, [approach.scenes for approach in approaches]),
    }


def look(detector: Detector, scenes: Scenes, texels: Tensor | None, share: float) -> Sight:
    """What the detector says of each frame.

    Args:
        detector: the (defended) victim.
        scenes: F frames.
        texels: the patch [3, P, P]; None leaves the sign alone.
        share: side of the patch in shares of the sign's.
    """
    label = detector.index(STOP_SIGN)
    patches = texels.unsqueeze(0) if texels is not None else None
    confidences, found = [], []
    for frames in torch.arange(len(scenes)).split(BATCH):
        predictions = detector(scenes.render(frames, patches, share))
        boxes = scenes.boxes[frames].to(predictions.boxes)
        confidences.append(confidence(predictions, label, boxes, iou=SAME_IOU))
        found += found_of(predictions, label)
    return Sight(torch.cat(confidences).numpy(), found)


@torch.no_grad()
def probed(detector: Detector, scenes: Scenes) -> dict[str, float]:
    """Whether a detector says the same of the nearest frame twice, and of a grey picture what it says of that frame."""
    label, last = detector.index(STOP_SIGN), torch.tensor([len(scenes) - 1])
    picture, box = scenes.render(last, None, 0.0), scenes.boxes[last]
    with torch.random.fork_rng(devices=[]):
        asked = [detector(each) for each in (picture, picture, torch.full_like(picture, 0.5))]
    first, again, grey = (confidence(each, label, box.to(each.boxes), iou=SAME_IOU) for each in asked)
    return {"redrawn": float(first != again), "same_answer": float((first - grey).abs() <= SAME_CONFIDENCE)}


def found_of(predictions: Predictions, label: int) -> list[Detections]:
    """The objects of one class that are detected in each picture."""
    only = replace(predictions, classes=predictions.classes[..., label : label + 1])
    return detections(only, threshold=stopping.THRESHOLD, iou=NMS_IOU)


def false_alarms(found: Sequence[Detections], boxes: Tensor) -> NDArray[np.int64]:
    """[N] detections in each picture that are not of the object at `boxes` [N, 4]."""
    return np.array([int((overlap(one.boxes, box) < SAME_IOU).sum()) for one, box in zip(found, boxes, strict=True)])


def measured(seen: Sequence[Sight], scenes: Sequence[Scenes]) -> Columns:
    """What is made of what was seen on A approaches, [A] each."""
    frames = {name: np.stack([getattr(one, name) for one in scenes]) for name in ("distance", "visible")}
    alarms = [false_alarms(sight.found, one.boxes).mean() for sight, one in zip(seen, scenes, strict=True)]
    return {
        "false_alarms": np.array(alarms),
        **measure(
            np.stack([sight.confidence for sight in seen]).astype(np.float64),
            frames["distance"].astype(np.float64),
            frames["visible"].astype(np.float64),
        ),
    }


def measure(confidence: stopping.Array, distance_m: stopping.Array, visible: stopping.Array) -> Columns:
    """What is made of the frames of A approaches, [A] each; frames in the order they are driven through.

    Args:
        confidence: [A, F] in the sign at its true place, in [0, 1]; 0 where the detector has no box there.
        distance_m: [A, F] to the sign.
        visible: [A, F] share of the sign that is to be seen.
    """
    detected = confidence > stopping.THRESHOLD
    confirmed_m = stopping.first(stopping.confirmed(detected), distance_m)
    return {
        "confidence_mean": confidence.mean(1),
        "confidence_median": np.median(confidence, 1),
        "detection_rate": detected.mean(1),
        "first_seen_m": stopping.first(detected, distance_m),
        "confirmed_m": confirmed_m,
        "overrun_m": stopping.overrun_m(confirmed_m),
        "ran": stopping.ran(confirmed_m),
        "visible_share": visible.mean(1),
        "frame_distance_m": distance_m,
        "frame_confidence": confidence,
        "frame_visible": visible,
    }


def check_approaches(approaches: Sequence[Approach], seeds: range, world: str) -> None:
    """Raise ValueError unless a world gives an approach a seed, all of one number of frames, farthest first."""
    if [approach.seed for approach in approaches] != list(seeds):
        raise ValueError(f"{world}.approaches gave seeds {[a.seed for a in approaches]}, asked for {list(seeds)}")
    if len({len(approach.scenes) for approach in approaches}) != 1:
        raise ValueError(f"{world}.approaches gave approaches of different numbers of frames")
    if any((approach.scenes.distance.diff() >= 0).any() for approach in approaches):
        raise ValueError(f"{world}.approaches gave frames that are not in order, farthest first")
