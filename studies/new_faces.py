"""Measures what detectors say of other words, other colours, real signs and foreign stop signs, on both halves of the sheet.

    python studies/new_faces.py --victims yolov3_tiny yolov5 --defenses none advtrain_detection [--each] [--picture faces.png]

The first half is kept back from every training; the other half may be in one (`advtrain_detection`, faces=signs). The faces of a
half take turns in the frames of all approaches, at places that no detector was trained at. Families: false stops a frame. Foreign
stop signs: share of frames in which they are detected.
"""

from __future__ import annotations

import argparse
import shlex
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from cavbench.core import registry
from cavbench.core.options import configured, parameter_words
from cavbench.detection import Detector, Scenes
from cavbench.detection.discrimination import stops_by_family
from cavbench.detection.sight import Sight, look_at_faces
from cavbench.envs.camera import faces
from cavbench.envs.camera.bank import BankScenes
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import in_one_line
from cavbench.run.process import settle

WORLD = StopSignApproach()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--victims", nargs="+", default=["yolov3_tiny"])
    parser.add_argument(
        "--defenses", nargs="+", default=["none"], help='with parameters: "advtrain_detection faces=signs"'
    )
    parser.add_argument("--weathers", nargs="+", default=["clear", "rain"])
    parser.add_argument("--lanes", nargs="+", type=int, default=[3, 4])
    parser.add_argument(
        "--each", action="store_true", help="also list the faces that are taken for a stop sign most often"
    )
    parser.add_argument(
        "--picture", type=Path, help="PNG of the faces on the signs of the nearest frames, kept back ones first"
    )
    asked = parser.parse_args()
    settle()
    cells = [WORLD.axes.cell(lanes=n, density=1.0, weather=weather) for n in asked.lanes for weather in asked.weathers]
    seen = [one.scenes for cell in cells for one in WORLD.approaches(cell, range(len(WORLD.locations)))]
    halves = {"kept back": of_half(seen, scored=True), "training": of_half(seen, scored=False)}
    if asked.picture:
        cv2.imwrite(str(asked.picture), np.concatenate([pictured(half) for half in halves.values()]))
    shown = ("false_stops_words", "false_stops_colours", "false_stops_signs", "false_stops_faces", "foreign_stops")
    print(f"{'':<42}{'half':<12}" + "".join(f"{name.removeprefix('false_stops_'):>15}" for name in shown))
    for name, detector in detectors(asked.victims, asked.defenses):
        for half, scenes in halves.items():
            with torch.no_grad():
                sights = [look_at_faces(detector, one) for one in scenes]
            found = stops_by_family(sights, scenes)
            print(f"{name:<42}{half:<12}" + "".join(f"{np.nanmean(found[one]):>15.2f}" for one in shown), flush=True)
            if asked.each:
                print(
                    "    " + ", ".join(f"{face} {often:.2f}" for face, often in worst(sights, scenes)[:10]), flush=True
                )


def of_half(seen: Sequence[BankScenes], *, scored: bool) -> list[BankScenes]:
    """The approaches with faces of a half of the sheet; other faces in each weather and on each road."""
    made = [one.with_decoys(one.decoys) for one in seen]
    for turn, one in enumerate(made):
        one.faces = faces.of_sheet(turn, len(one), scored=scored)
    return made


def detectors(victims: Sequence[str], defenses: Sequence[str]) -> Iterator[tuple[str, Detector]]:
    for victim in victims:
        undefended = registry.load("victim", victim)()
        for defense in defenses:
            name, *parameters = shlex.split(defense)
            made = configured("defense", name, parameter_words(" ".join(parameters))).component
            yield f"{victim}, {defense}", made.load(undefended, 0, WORLD.facts)


def worst(sights: Sequence[Sight | None], scenes: Sequence[Scenes]) -> list[tuple[str, float]]:
    """The false stops a frame of each face, the most first; no foreign stop signs."""
    stops: dict[str, list[int]] = defaultdict(list)
    for sight, one in zip(sights, scenes, strict=True):
        assert sight is not None
        for face, found in zip(one.faces, sight.found, strict=True):
            if face.family in faces.FAMILIES:
                stops[face.name].append(len(found.scores))
    return sorted(((name, float(np.mean(counts))) for name, counts in stops.items()), key=lambda one: -one[1])


def pictured(scenes: Sequence[BankScenes]) -> np.ndarray:
    """The surroundings of the sign in the nearest frame of an approach with each of its faces, BGR."""
    shown = []
    for one in scenes[:4]:
        nearest = len(one) - 1
        x0, y0, x1, y1 = one.boxes[nearest].round().long().tolist()
        row = []
        for face in one.faces:
            image = one.with_decoys([face] * len(one)).render_decoys(torch.tensor([nearest]))[0]
            part = (
                (255 * image[:, max(0, y0 - 20) : y1 + 20, max(0, x0 - 20) : x1 + 20]).byte().permute(1, 2, 0).numpy()
            )
            row.append(cv2.resize(part[..., ::-1], (148, 148)))
        shown.append(np.concatenate(row, 1))
    return np.concatenate(shown)


if __name__ == "__main__":
    with in_one_line():
        main()
