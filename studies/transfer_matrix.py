"""Scores detectors under patches that were crafted against other detectors, and against several at once (`transfer`).

    python studies/transfer_matrix.py [--detectors yolov3_tiny yolov5 fcos rcnn] [--hardened yolov3_tiny] [--steps 600]
        [--cutout 0.9] [--shake-drop 0] [--lanes 3 4] [--weathers clear rain] [--rows rcnn]

Each row is a patch, each column a detector that sees it; hardened detectors have columns only. On the diagonal the attack is a
white box. The last row is the universal patch, crafted against all. `--rows` names the surrogates of the rows to make, joined
by + for a universal patch. The score is the stop score, the mean over all approaches.
"""

from __future__ import annotations

import argparse

import numpy as np

from cavbench.attacks.detection.transfer import BETWEEN, Transfer
from cavbench.core import registry
from cavbench.core.pair import choose
from cavbench.detection import DetectorDefense, DetectorVictim, PatchThreat
from cavbench.detection.approach import score
from cavbench.detection.crafting import craft
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import in_one_line
from cavbench.run.process import settle

WORLD = StopSignApproach()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--detectors", nargs="+", default=["yolov3_tiny", "yolov5", "fcos", "rcnn"])
    parser.add_argument("--hardened", nargs="*", default=[], help="detectors that are scored hardened, too")
    parser.add_argument("--steps", type=int, default=Transfer.steps)
    parser.add_argument("--cutout", type=float, default=Transfer.cutout)
    parser.add_argument("--shake-drop", type=float, default=Transfer.shake_drop)
    parser.add_argument("--lanes", nargs="+", type=int, default=[3, 4])
    parser.add_argument("--weathers", nargs="+", default=["clear", "rain"])
    parser.add_argument("--rows", nargs="+", default=[], help="make only these rows")
    asked = parser.parse_args()
    settle()
    threat, scenes = PatchThreat(), WORLD.training_scenes()
    victims: dict[str, DetectorVictim] = {name: registry.load("victim", name)() for name in asked.detectors}
    seeing = {name: victim.load(0, WORLD.facts) for name, victim in victims.items()}
    defense: DetectorDefense = registry.load("defense", "advtrain_detection")()
    for name in asked.hardened:
        seeing[f"{name}+"] = defense.load(registry.load("victim", name)(), 0, WORLD.facts)
    cells = [WORLD.axes.cell(lanes=n, density=1.0, weather=weather) for n in asked.lanes for weather in asked.weathers]
    approaches = [each for cell in cells for each in WORLD.approaches(cell, range(len(WORLD.locations)))]
    print(f"{'crafted against':<20}" + "".join(f"{name:>15}" for name in seeing) + "     (+ hardened)", flush=True)
    universal = [BETWEEN.join(asked.detectors)] if len(asked.detectors) > 1 else []
    for surrogates in asked.rows or ("nothing", *asked.detectors, *universal):
        patch = None
        if surrogates != "nothing":
            options = {"steps": asked.steps, "cutout": asked.cutout, "shake_drop": asked.shake_drop}
            attack = choose("attack", "transfer", surrogates=surrogates, **options).component
            victim = next(iter(seeing.values()))
            patch = craft(attack, victim, scenes, threat, attack_seed=0, progress=lambda share, text: None)
        stops = [
            np.mean(score(detector, approaches, patch, share=threat.budget)["stop_score"])
            for detector in seeing.values()
        ]
        print(
            f"{'all' if surrogates in universal else surrogates:<20}" + "".join(f"{stop:>15.2f}" for stop in stops),
            flush=True,
        )


if __name__ == "__main__":
    with in_one_line():
        main()
