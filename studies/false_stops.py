"""Says where detectors see stop signs that are not there: on which decoys, and on what else in the image.

    python studies/false_stops.py [--victims yolov5] [--weathers clear rain] [--lanes 3 4]

False stops a frame, on the frames with decoys at the places that are scored. A detection is on the decoy if it overlaps the place
of the sign, on another object if it overlaps its box, and otherwise in the background.
"""

from __future__ import annotations

import argparse
from collections import Counter

import torch
from torch import Tensor

from cavbench.core import registry
from cavbench.detection import Objects
from cavbench.detection.boxes import overlap
from cavbench.detection.sight import look_at_decoys
from cavbench.envs.camera.bank import BankScenes
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import in_one_line
from cavbench.run.process import settle

WORLD = StopSignApproach()
SAME = 0.1
"""Smallest IoU of a detection with what it is on."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--victims", nargs="+", default=["yolov5"])
    parser.add_argument("--weathers", nargs="+", default=["clear", "rain"])
    parser.add_argument("--lanes", nargs="+", type=int, default=[3, 4])
    asked = parser.parse_args()
    settle()
    cells = [WORLD.axes.cell(lanes=n, density=1.0, weather=weather) for n in asked.lanes for weather in asked.weathers]
    approaches = [one.scenes for cell in cells for one in WORLD.approaches(cell, range(len(WORLD.locations)))]
    frames = sum(len(scenes) for scenes in approaches)
    for name in asked.victims:
        detector = registry.load("victim", name)().load(0, WORLD.facts)
        where: Counter[str] = Counter()
        for scenes in approaches:
            with torch.no_grad():
                seen = look_at_decoys(detector, scenes)
            assert seen is not None
            for frame, found in enumerate(seen.found):
                where.update(place(box, scenes, frame) for box in found.boxes)
        parts = "".join(f", {count / frames:.3f} {what}" for what, count in where.most_common())
        print(f"{name}: {where.total() / frames:.3f} false stops a frame on {frames} frames{parts}", flush=True)


def place(box: Tensor, scenes: BankScenes, frame: int) -> str:
    """What a box [4] is on."""
    if overlap(box, scenes.boxes[frame]) >= SAME:
        return f"on the decoy {scenes.decoys[frame].name}"
    known: Objects = scenes.objects(frame)
    shared = overlap(box, known.boxes)
    return f"on a {known.names[int(shared.argmax())]}" if shared.max() >= SAME else "in the background"


if __name__ == "__main__":
    with in_one_line():
        main()
