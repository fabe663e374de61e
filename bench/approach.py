"""The work of a unit of the detection track: a defended detector on every approach of a cell, with the patch on the sign."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench import stopping
from bench.patch import Patch
from bench.unit import Unit
from bench.vision import STOP_SIGN, Approach, Detector, Predictions, Scenes, confidence, detections, overlap

Columns = dict[str, NDArray[np.generic]]

BATCH = 16
"""Frames looked at at once."""
NMS_IOU, SAME_IOU = 0.45, 0.3
"""Of non-maximum suppression (YOLOv5's default), and from which a detection is of the sign itself (`vision.confidence`)."""


def score(unit: Unit, patch: Patch | None) -> Columns:
    """Do the work of a unit and return the measurements of its approaches, [A] each.

    Args:
        unit: what to drive up to.
        patch: what `unit.crafting` made; None where there is none.

    Raises:
        ValueError: if the world does not give an approach a seed, all of one number of frames, farthest first.
    """
    _, defense, victim, world = (part.component for part in unit.parts)
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(unit.attack_seed)
        detector = defense.load(victim, unit.training_seed)
        approaches = world.approaches(unit.cell, unit.seeds)
        _check(approaches, unit.seeds, type(world).__name__)
        texels = patch.texels if patch else None
        seen = [look(detector, approach.scenes, texels, unit.pair.threat.budget) for approach in approaches]
    frames = {
        name: np.stack([getattr(approach.scenes, name) for approach in approaches]) for name in ("distance", "visible")
    }
    crafted = patch or Patch(texels=None)
    constant = {
        "patch": unit.crafting.fingerprint if unit.crafting else "",
        "patch_sha256": crafted.sha256,
        "queries": crafted.queries,
        "gradients": crafted.gradients,
        "crafting_s": crafted.seconds,
        "excess": crafted.excess,
    }
    return {
        "seed": np.array(unit.seeds, np.int64),
        "location": np.array([approach.location for approach in approaches]),
        **{name: np.array([value] * len(approaches)) for name, value in constant.items()},
        "false_alarms": np.array([alarms.mean() for _, alarms in seen]),
        **measure(
            np.stack([confidences for confidences, _ in seen]).astype(np.float64),
            frames["distance"].astype(np.float64),
            frames["visible"].astype(np.float64),
        ),
    }


def look(
    detector: Detector, scenes: Scenes, texels: Tensor | None, share: float
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """What the detector says of each frame [F]: its confidence in the sign, and how many stop signs it sees elsewhere.

    Args:
        detector: the (defended) victim.
        scenes: F frames.
        texels: the patch [3, P, P]; None leaves the sign alone.
        share: side of the patch in shares of the sign's.
    """
    label = detector.index(STOP_SIGN)
    patches = texels.unsqueeze(0) if texels is not None else None
    confidences, alarms = [], []
    for frames in torch.arange(len(scenes)).split(BATCH):
        predictions = detector(scenes.render(frames, patches, share))
        boxes = scenes.boxes[frames].to(predictions.boxes)
        confidences.append(confidence(predictions, label, boxes, iou=SAME_IOU))
        alarms.append(false_alarms(predictions, label, boxes))
    return torch.cat(confidences).numpy(), torch.cat(alarms).numpy()


def false_alarms(predictions: Predictions, label: int, boxes: Tensor) -> Tensor:
    """[N] detections of a class that are not of the object at `boxes` [N, 4]."""
    only = replace(predictions, classes=predictions.classes[..., label : label + 1])
    found = detections(only, threshold=stopping.THRESHOLD, iou=NMS_IOU)
    return torch.tensor(
        [int((overlap(one.boxes, box) < SAME_IOU).sum()) for one, box in zip(found, boxes, strict=True)]
    )


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


def _check(approaches: Sequence[Approach], seeds: range, world: str) -> None:
    if [approach.seed for approach in approaches] != list(seeds):
        raise ValueError(f"{world}.approaches gave seeds {[a.seed for a in approaches]}, asked for {list(seeds)}")
    if len({len(approach.scenes) for approach in approaches}) != 1:
        raise ValueError(f"{world}.approaches gave approaches of different numbers of frames")
    if any((approach.scenes.distance.diff() >= 0).any() for approach in approaches):
        raise ValueError(f"{world}.approaches gave frames that are not in order, farthest first")
