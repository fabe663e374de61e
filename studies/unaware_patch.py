"""Scores defences against a patch that does not know of them: `eot` crafts it against the undefended detector.

    python studies/unaware_patch.py segmenter [--victim yolov3_tiny] [--steps 150] [--lanes 3 4] [--weathers clear rain]

`bench run` crafts against the defended detector. The difference between the two scores is what an attack gains that knows of the
defence. The columns are those of the records, means over all approaches.
"""

from __future__ import annotations

import argparse

import numpy as np

from cavbench.attacks.detection.eot import EOT
from cavbench.core import registry
from cavbench.detection import PatchThreat
from cavbench.detection.approach import score
from cavbench.detection.crafting import craft
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import in_one_line
from cavbench.run.process import settle

WORLD = StopSignApproach()
MEASURES = ("stop_score", "confidence_mean", "average_precision", "decoy_confidence", "false_stops", "ran")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("defenses", nargs="+")
    parser.add_argument("--victim", default="yolov3_tiny")
    parser.add_argument("--steps", type=int, default=150, help="of `eot`")
    parser.add_argument("--lanes", nargs="+", type=int, default=[3, 4])
    parser.add_argument("--weathers", nargs="+", default=["clear", "rain"])
    asked = parser.parse_args()
    settle()
    threat, victim = PatchThreat(), registry.load("victim", asked.victim)()
    undefended = victim.load(0, WORLD.facts)
    patch = craft(
        EOT(steps=asked.steps),
        undefended,
        WORLD.training_scenes(),
        threat,
        attack_seed=0,
        progress=lambda share, text: None,
    )
    cells = [WORLD.axes.cell(lanes=n, density=1.0, weather=weather) for n in asked.lanes for weather in asked.weathers]
    print(f"{'':<24}" + "".join(f"{name:>20}" for name in MEASURES))
    for name in ("none", *asked.defenses):
        detector = registry.load("defense", name)().load(victim, 0, WORLD.facts)
        columns = [
            score(detector, WORLD.approaches(cell, range(len(WORLD.locations))), patch, share=threat.budget)
            for cell in cells
        ]
        means = "".join(f"{np.nanmean([one[measure] for one in columns]):>20.2f}" for measure in MEASURES)
        print(f"{name:<24}{means}", flush=True)


if __name__ == "__main__":
    with in_one_line():
        main()
