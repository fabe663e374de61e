"""Detectors: detections in one frame of an approach, and the confidence in the sign in every weather."""

from __future__ import annotations

import torch
from matplotlib.figure import Figure

from cavbench.detection.boxes import detections
from cavbench.detection.sight import NMS_IOU
from cavbench.detection.stopping import THRESHOLD
from cavbench.envs.weather import WEATHERS
from docs.figures import style
from docs.figures.sightings import FRAME, approaches, box, detector, frame_axes, picture, show, sight

COLOURS = {"clear": style.ORANGE, "rain": style.BLUE, "fog": style.GREY, "night": style.INK}
DASHES = {"clear": "-", "rain": "--", "fog": "-.", "night": ":"}
AROUND = 140
"""Pixels of the image that are shown beside the outermost boxes."""
BOXES = (style.GREEN, style.SKY, style.YELLOW, style.PURPLE)


def yolov3_tiny() -> Figure:
    """The small detector with its official weights."""
    return _figure("yolov3_tiny")


def yolov5() -> Figure:
    """The detector trained on the camera world."""
    return _figure("yolov5")


def fcos() -> Figure:
    """The detector without anchors."""
    return _figure("fcos")


def rcnn() -> Figure:
    """The detector with two stages."""
    return _figure("rcnn")


def _figure(victim: str) -> Figure:
    of, approach = detector(victim), approaches()[0]
    shown = picture(approach, FRAME)
    with torch.no_grad():
        (found,) = detections(of(shown[None]), threshold=THRESHOLD, iou=NMS_IOU)
    made = style.figure(4.8, f"{victim}: what it finds {approach.scenes.distance[FRAME]:.0f} m before the sign")
    frame, curves = made.subplots(2, 1, height_ratios=(1.25, 1))
    left = max(0, int(found.boxes[:, 0].min()) - AROUND)
    show(frame, shown[:, :, left : int(found.boxes[:, 2].max()) + AROUND])
    labels = sorted(set(found.labels.tolist()))
    for number, place in enumerate(found.boxes[:, 0].argsort().tolist()):
        label, corners = int(found.labels[place]), found.boxes[place] - torch.tensor([left, 0, left, 0])
        text = f"{of.names[label]} {float(found.scores[place]):.2f}"
        box(frame, corners, text, BOXES[labels.index(label) % len(BOXES)], below=number % 2 == 1)
    for weather in WEATHERS:
        seen = sight(of, approaches(weather)[0]).confidence
        distance = approaches(weather)[0].scenes.distance
        curves.plot(distance, seen, color=COLOURS[weather], ls=DASHES[weather], lw=2.2, marker="o", ms=4, label=weather)
    frame_axes(curves)
    curves.set_title("confidence in the sign on this approach, by weather", fontsize=10)
    curves.legend(loc="lower center", ncols=4, fontsize=9.5)
    return made
