"""Measures what detectors say of decoys: faces that no training sees, which are scored, and the faces of the training scenes.

    python studies/decoy_faces.py [--victims yolov3_tiny] [--skips 0.3] [--weathers clear rain] [--lanes 3]

The places are those that are scored, so both kinds of faces are seen at places that no detector was trained at. The means are
over the frames of all approaches; the training faces take turns in them as the others do.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from copy import copy

import numpy as np
import torch

from cavbench.core import registry
from cavbench.detection import Detector
from cavbench.detection.discrimination import discrimination
from cavbench.detection.sight import look, look_at_decoys
from cavbench.envs.camera import training_faces
from cavbench.envs.camera.bank import BankScenes
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import in_one_line
from cavbench.run.process import settle

WORLD = StopSignApproach()
MEASURES = ("decoy_confidence", "octagons", "false_stops", "average_precision")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--victims", nargs="+", default=["yolov3_tiny"])
    parser.add_argument("--skips", nargs="*", type=float, default=[0.3], help="of `advtrain_detection`")
    parser.add_argument("--weathers", nargs="+", default=["clear", "rain"])
    parser.add_argument("--lanes", nargs="+", type=int, default=[3])
    asked = parser.parse_args()
    settle()
    cells = [WORLD.axes.cell(lanes=n, density=1.0, weather=weather) for n in asked.lanes for weather in asked.weathers]
    approaches = [one.scenes for cell in cells for one in WORLD.approaches(cell, range(len(WORLD.locations)))]
    print(f"{'':<24} {'faces':<10}" + "".join(f"{name:>20}" for name in MEASURES))
    for name, detector in detectors(asked.victims, asked.skips):
        with torch.no_grad():
            seen = [look(detector, scenes, None, 0.5) for scenes in approaches]
        for faces, shown in (("scored", approaches), ("training", with_training_faces(approaches))):
            with torch.no_grad():
                decoys = [look_at_decoys(detector, scenes) for scenes in shown]
            found = discrimination(seen, decoys, shown)
            means = "".join(f"{np.nanmean(found[measure]):>20.2f}" for measure in MEASURES)
            print(f"{name:<24} {faces:<10}{means}", flush=True)


def detectors(victims: list[str], skips: list[float]) -> Iterator[tuple[str, Detector]]:
    """Each victim, undefended and adversarially trained with each skip probability."""
    for name in victims:
        victim = registry.load("victim", name)()
        yield name, victim.load(0, WORLD.facts)
        for skip in skips:
            defense = registry.load("defense", "advtrain_detection")(skip=skip)
            yield f"{name}, skip {skip:g}", defense.load(victim, 0, WORLD.facts)


def with_training_faces(approaches: list[BankScenes]) -> list[BankScenes]:
    """The same approaches with faces of the first round of a training."""
    scenes = [copy(one) for one in approaches]
    for turn, one in enumerate(scenes):
        one.decoys = training_faces.decoys(turn * len(one), len(one))
    return scenes


if __name__ == "__main__":
    with in_one_line():
        main()
