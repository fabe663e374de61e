"""Measures what is saved by scoring several patches on the same approaches together, as `bench run` does:

    python benchmarks/patches_together.py [--victim yolov3_tiny] [--defense none] [--patches 6] [--rounds 1]

Alternates units that are carried out one by one with the same units in one batch, in one process and one thread, on one cell of
`approach-v1`, with random patches. Prints CPU seconds, medians over the rounds, and the median of the ratios of the rounds.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch

from cavbench.core.pair import Pair, choose
from cavbench.core.track import Job
from cavbench.detection.drive import drive, drive_jointly
from cavbench.detection.patch import Patch
from cavbench.envs.camera.axes import APPROACH_V1
from cavbench.errors import in_one_line
from cavbench.run.process import settle


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--victim", default="yolov3_tiny")
    parser.add_argument("--defense", default="none")
    parser.add_argument("--patches", type=int, default=6)
    parser.add_argument("--rounds", type=int, default=1)
    asked = parser.parse_args()
    settle()
    jobs, artefacts = work(asked.victim, asked.defense, asked.patches)
    alone, together = [], []
    for _ in range(asked.rounds):
        alone.append(seconds(lambda: [drive(job, artefacts[job.artefact], ()) for job in jobs]))
        together.append(seconds(lambda: drive_jointly(jobs, artefacts)))
    ratio = statistics.median(one / other for one, other in zip(alone, together, strict=True))
    print(
        f"{asked.patches} patches, {asked.defense} + {asked.victim}: alone {statistics.median(alone):.1f} s, "
        f"together {statistics.median(together):.1f} s, {ratio:.2f} x as fast"
    )


def work(victim: str, defense: str, patches: int) -> tuple[list[Job], dict[str, bytes]]:
    """A unit for each of some random patches in one cell, and the patches."""
    found = choose("victim", victim)
    pair = Pair(
        attack=choose("attack", "noise_patch"),
        defense=choose("defense", defense),
        victim=found,
        world=choose("world", "camera"),
        threat=found.component.threat(),
    )
    cell, seeds = APPROACH_V1.cells()[0], APPROACH_V1.seeds()
    jobs = [
        Job(pair=pair, training_seed=0, attack_seed=0, cell=cell, seeds=seeds, artefact=str(number))
        for number in range(patches)
    ]
    torch.manual_seed(0)
    return jobs, {job.artefact: Patch(torch.rand(3, 100, 100)).written("") for job in jobs}


def seconds(carry_out: Callable[[], object]) -> float:
    """CPU seconds."""
    start = time.process_time()
    if carry_out() is None:
        raise SystemExit("the units cannot be carried out together")
    return time.process_time() - start


if __name__ == "__main__":
    with in_one_line():
        main()
