"""Drives cars of `crossing` without the open-loop measurements of a run: each frame is looked at once, whatever the speed.

    python studies/crossing_drives.py [--victims yolov3_tiny] [--defenses none advtrain_detection] [--weathers clear rain]
        [--lenses clean drops] [--speeds 8 10 12] [--attacks none grey_patch] [--budget 0.5] [--reactions 0.75] [--draws 200]

The columns are those of the records: the share of the draws of the cross traffic, and metres.
"""

from __future__ import annotations

import argparse
from typing import Any

import torch
from torch import Tensor

from cavbench.core import registry
from cavbench.detection import PatchThreat
from cavbench.detection.closed_loop import drive, measured
from cavbench.detection.crafting import craft
from cavbench.detection.detector import Detector
from cavbench.envs.camera.crossing import StopSignCrossing
from cavbench.errors import in_one_line
from cavbench.run.process import settle
from studies.temporal_evidence import Once


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--victims", nargs="+", default=["yolov3_tiny"])
    parser.add_argument("--defenses", nargs="+", default=["none"])
    parser.add_argument("--weathers", nargs="+", default=["clear", "rain", "fog"])
    parser.add_argument("--lenses", nargs="+", default=["clean"])
    parser.add_argument("--speeds", nargs="+", type=float, default=[8.0, 10.0, 12.0])
    parser.add_argument("--attacks", nargs="+", default=["none"], help="attacks that need no queries")
    parser.add_argument("--budget", type=float, default=0.5)
    parser.add_argument("--reactions", nargs="+", type=float, default=[0.75])
    parser.add_argument("--draws", type=int, default=200)
    asked = parser.parse_args()
    settle()
    header_shown = False
    for victim in asked.victims:
        for defense in asked.defenses:
            inner = registry.load("defense", defense)().load(
                registry.load("victim", victim)(), 0, StopSignCrossing().facts
            )
            for attack in asked.attacks:
                texels = _texels(attack, inner, asked.budget)
                for weather in asked.weathers:
                    for lens in asked.lenses:
                        detector = Once(inner)
                        for speed in asked.speeds:
                            for reaction in asked.reactions:
                                world = StopSignCrossing(reaction=reaction)
                                cell = world.axes.cell(weather=weather, lens=lens, speed=speed)
                                env = world.environment(cell, range(asked.draws), texels, asked.budget)
                                found = measured(drive(detector, env), asked.draws)
                                if not header_shown:
                                    print(f"{'':<60}" + "".join(f"{name:>18}" for name in found))
                                    header_shown = True
                                title = (
                                    f"{victim} {defense}, {attack}, {weather}, {lens}, {speed:g} m/s, {reaction:g} s"
                                )
                                means = "".join(f"{float(values.mean()):>18.2f}" for values in found.values())
                                print(f"{title:<60}{means}", flush=True)


def _texels(attack: str, detector: Detector, budget: float) -> Tensor | None:
    """The patch of an attack that needs no queries."""
    chosen: Any = registry.load("attack", attack)()
    if attack == "none":
        return None
    scenes = StopSignCrossing().training_scenes()
    patch = craft(chosen, detector, scenes, PatchThreat(budget=budget), attack_seed=0, progress=lambda *told: None)
    return patch.texels


if __name__ == "__main__":
    with in_one_line(), torch.no_grad():
        main()
