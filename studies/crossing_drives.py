"""Drives cars of `crossing` without the open-loop measurements of a run: each frame is looked at once, whatever the speed.

    python studies/crossing_drives.py [--victims yolov3_tiny] [--defenses none advtrain_detection] [--weathers clear rain]
        [--lenses clean drops] [--speeds 8 10 12] [--attacks none grey_patch eot] [--budget 0.5] [--reactions 0.75]
        [--draws 200] [--steps 300] [--patches FOLDER]

The columns are those of the records: the share of the draws of the cross traffic, and metres. `eot` is the turned and scaled one
with large steps of `standard-detection-3`, with one start and batches of 6. `--patches` keeps what was crafted.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torch import Tensor

from cavbench.attacks.detection.eot import EOT
from cavbench.attacks.detection.grey_patch import GreyPatch
from cavbench.attacks.detection.noise_patch import NoisePatch
from cavbench.attacks.detection.suites import STANDARD_DETECTION_3
from cavbench.core import registry
from cavbench.detection import PatchThreat, Scenes
from cavbench.detection.closed_loop import drive, measured
from cavbench.detection.crafting import craft
from cavbench.detection.detector import Detector
from cavbench.detection.patch import Patch
from cavbench.envs.camera.crossing import StopSignCrossing
from cavbench.errors import in_one_line
from cavbench.files import whole
from cavbench.run.process import settle
from cavbench.statistics.estimates import share_interval
from studies.temporal_evidence import Once

LARGE_STEPS = {**STANDARD_DETECTION_3.members[3].params, "restarts": 1, "batch": 6}


class Album(Scenes):
    """Scenes under one patch whose images are kept, so that each frame is rendered once, whatever the speed."""

    def __init__(self) -> None:
        self.shown: dict[int, Tensor] = {}

    def of(self, scenes: Scenes) -> Album:
        self.scenes, self.size = scenes, scenes.size
        self.boxes, self.visible, self.distance = scenes.boxes, scenes.visible, scenes.distance
        return self

    def render(self, frames: Tensor, patches: Tensor | None, share: float) -> Tensor:
        for number in frames.tolist():
            if number not in self.shown:
                (self.shown[number],) = self.scenes.render(torch.tensor([number]), patches, share)
        return torch.stack([self.shown[number] for number in frames.tolist()])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--victims", nargs="+", default=["yolov3_tiny"])
    parser.add_argument("--defenses", nargs="+", default=["none"])
    parser.add_argument("--weathers", nargs="+", default=["clear", "rain", "fog"])
    parser.add_argument("--lenses", nargs="+", default=["clean"])
    parser.add_argument("--speeds", nargs="+", type=float, default=[8.0, 10.0, 12.0])
    parser.add_argument("--attacks", nargs="+", default=["none"], choices=["none", "grey_patch", "noise_patch", "eot"])
    parser.add_argument("--budget", type=float, default=0.5)
    parser.add_argument("--reactions", nargs="+", type=float, default=[0.75])
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--steps", type=int, default=300, help="of `eot`")
    parser.add_argument("--patches", type=Path, help="folder in which crafted patches are kept")
    asked = parser.parse_args()
    settle()
    header_shown = False
    for victim in asked.victims:
        for defense in asked.defenses:
            inner = registry.load("defense", defense)().load(
                registry.load("victim", victim)(), 0, StopSignCrossing().facts
            )
            for attack in asked.attacks:
                name = f"{victim}-{defense}-{attack}-{asked.steps}-{asked.budget:g}.safetensors"
                kept = asked.patches and asked.patches / name
                patch = _patch(attack, inner, PatchThreat(budget=asked.budget), asked.steps, kept)
                for weather in asked.weathers:
                    for lens in asked.lenses:
                        detector, album = Once(inner), Album()
                        for speed in asked.speeds:
                            for reaction in asked.reactions:
                                world = StopSignCrossing(reaction=reaction)
                                cell = world.axes.cell(weather=weather, lens=lens, speed=speed)
                                env = world.environment(cell, range(asked.draws), patch.texels, asked.budget)
                                env.scenes = (album.of(env.scenes[0]),)
                                found = measured(drive(detector, env), asked.draws)
                                if not header_shown:
                                    print(
                                        f"{'':<60}"
                                        + "".join(f"{name:>18}" for name in found)
                                        + f"{'collided, 95 %':>18}"
                                    )
                                    header_shown = True
                                title = (
                                    f"{victim} {defense}, {attack}, {weather}, {lens}, {speed:g} m/s, {reaction:g} s"
                                )
                                means = "".join(f"{float(values.mean()):>18.2f}" for values in found.values())
                                collided = share_interval(found["collided"].astype(float)[None, None])
                                print(f"{title:<60}{means}{collided.low:>10.2f} to {collided.high:.2f}", flush=True)


def _patch(attack: str, detector: Detector, threat: PatchThreat, steps: int, kept: Path | None) -> Patch:
    """The patch of an attack, read from a file if it is there; without texels for `none`."""
    if attack == "none":
        return Patch(texels=None)
    if kept and kept.exists():
        return Patch.read(kept.read_bytes())
    chosen = {"eot": EOT(**{**LARGE_STEPS, "steps": steps}), "grey_patch": GreyPatch(), "noise_patch": NoisePatch()}[
        attack
    ]
    scenes = StopSignCrossing().training_scenes()
    with torch.enable_grad():
        patch = craft(chosen, detector, scenes, threat, attack_seed=0, progress=lambda share, text: None)
    if kept:
        kept.parent.mkdir(parents=True, exist_ok=True)
        with whole(kept) as file:
            file.write(patch.written("studies/crossing_drives.py"))
    return patch


if __name__ == "__main__":
    with in_one_line(), torch.no_grad():
        main()
