"""Patches that are crafted with the detector in bfloat16 beside those in float32; both are scored in float32:

    python -m studies.half_precision yolov5:none:shifts yolov3_tiny:advtrain_detection:turned --seeds 3

Each argument is a victim, a defence and a member of the suite with one start. Prints the mean confidence on three approaches of
three cells (the seeds are not those of the grid), and the CPU time of the crafting.
"""

from __future__ import annotations

import argparse
import time
from typing import get_args

import numpy as np
import torch

from cavbench.attacks.detection.eot import EOT
from cavbench.attacks.detection.suites import STANDARD_DETECTION_3
from cavbench.core.pair import choose
from cavbench.detection import PatchThreat
from cavbench.detection.crafting import craft
from cavbench.detection.half import Precision
from cavbench.detection.sight import look
from cavbench.envs.camera.axes import APPROACH_V1
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import in_one_line
from cavbench.run.process import settle

SEEDS, EVERY = range(2_000_000, 2_000_003), 6
MEMBERS = {
    "turned" if member.params["rotation"] else "large" if "learning_rate" in member.params else "shifts": member.params
    for member in STANDARD_DETECTION_3.members
    if "rotation" in member.params
}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "pairs", nargs="+", metavar="VICTIM:DEFENSE:MEMBER", help=f"MEMBER is one of {', '.join(MEMBERS)}"
    )
    parser.add_argument("--seeds", type=int, default=3, help="patch seeds")
    arguments = parser.parse_args()
    settle()
    world, threat = StopSignApproach(), PatchThreat()
    approaches = [one for cell in list(APPROACH_V1.cells())[::EVERY] for one in world.approaches(cell, SEEDS)]
    for pair in arguments.pairs:
        victim, defense, member = pair.split(":")
        detector = choose("defense", defense).component.load(choose("victim", victim).component, 0, world.facts)
        for seed in range(arguments.seeds):
            for precision in get_args(Precision):
                attack, start = EOT(**MEMBERS[member] | {"restarts": 1}, precision=precision), time.process_time()
                made = craft(
                    attack,
                    detector,
                    world.training_scenes(),
                    threat,
                    attack_seed=seed,
                    progress=lambda share, text: None,
                )
                seconds = time.process_time() - start
                with torch.no_grad():
                    sights = [look(detector, one.scenes, made.texels, threat.budget) for one in approaches]
                score = np.mean([sight.confidence.mean() for sight in sights])
                print(f"{pair}, patch {seed}, {precision}: {score:.3f}, {seconds:.0f} CPU s", flush=True)


if __name__ == "__main__":
    with in_one_line():
        main()
