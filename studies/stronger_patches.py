"""Measures what a detector keeps under other variants of the last `eot` of `standard-detection-3`.

    python studies/stronger_patches.py [--victim yolov5] [--defense advtrain_detection] [--only NAME ...] [--device cuda]

Each line is one patch, crafted on the training places and shown in the approaches of four cells (three and four lanes, clear and
rain): the mean confidence at the sign, the lowest mean of an approach, and the images that the attack asked about. `suite`,
`shifts only` and `shifts only, batch 6, small steps` are the longer `eot` of the suite with one start instead of three: a variant
that leaves less than all of them hints that the suite is too weak for this detector. Starts differ by 0.1 and more (`--seed`).
Takes 1 to 50 minutes a line.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import torch

from cavbench.attacks.detection.eot import EOT
from cavbench.core import registry, suites
from cavbench.detection import PatchThreat
from cavbench.detection.crafting import craft
from cavbench.detection.placed import placed
from cavbench.detection.sight import look
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import in_one_line
from cavbench.run.process import settle

WORLD = StopSignApproach()
SHIFTED = {"scale": 0.0, "rotation": 0.0}
VARIANTS: dict[str, dict[str, Any]] = {
    "suite": {},
    "1000 steps": {"steps": 1000},
    "batch 6": {"batch": 6},
    "batch 6, 1000 steps": {"batch": 6, "steps": 1000},
    "batch 32": {"batch": 32},
    "small steps": {"learning_rate": 0.05},
    "medium steps": {"learning_rate": 0.2},
    "shifts only": SHIFTED,
    "shifts only, 1000 steps": SHIFTED | {"steps": 1000},
    "shifts only, batch 6": SHIFTED | {"batch": 6},
    "shifts only, batch 6, 1000 steps": SHIFTED | {"batch": 6, "steps": 1000},
    "shifts only, batch 6, small steps": SHIFTED | {"batch": 6, "learning_rate": 0.05},
    "all transformations": {
        "perspective": 0.15,
        "brightness": 0.2,
        "contrast": 0.2,
        "saturation": 0.2,
        "hue": 0.05,
        "noise": 0.02,
    },
    "probability": {"loss": "probability"},
    "window 320": {"window": 320},
    "50 texels": {"texels": 50},
    "no total variation": {"tv": 0.0},
}
"""Parameters that differ from those of the suite's last `eot`, with one start each."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--victim", default="yolov5")
    parser.add_argument("--defense", default="advtrain_detection")
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    asked = parser.parse_args()
    settle()
    defense = registry.load("defense", asked.defense)()
    detector = placed(defense.load(registry.load("victim", asked.victim)(), 0, WORLD.facts), asked.device)
    cells = [WORLD.axes.cell(lanes=n, density=1.0, weather=weather) for n in (3, 4) for weather in ("clear", "rain")]
    approaches = [one.scenes for cell in cells for one in WORLD.approaches(cell, range(len(WORLD.locations)))]
    title = f"{asked.victim}, {asked.defense}, seed {asked.seed}"
    print(f"{title:<48}{'confidence':>16}{'lowest':>8}{'images':>8}{'s':>6}")
    threat, training = PatchThreat(), WORLD.training_scenes()
    for name in asked.only:
        attack = replace(last_of_suite(), restarts=1, **VARIANTS[name])
        made = craft(attack, detector, training, threat, attack_seed=asked.seed, progress=lambda share, text: None)
        with torch.no_grad():
            means = [float(look(detector, one, made.texels, threat.budget).confidence.mean()) for one in approaches]
        mean = sum(means) / len(means)
        print(f"{name:<48}{mean:>16.2f}{min(means):>8.2f}{made.queries:>8}{made.seconds:>6.0f}", flush=True)


def last_of_suite() -> EOT:
    """The last `eot` of the suite."""
    *_, last = (one.chosen.component for one in suites.suite("standard-detection-3").members if one.attack == "eot")
    return last


if __name__ == "__main__":
    with in_one_line():
        main()
