"""What each member of a suite costs and takes: python studies/suite_cost.py [SUITE] [EPISODES].

One pair (`dqn`, adversarially trained, seed 0) on 4 lanes, density 1, clear weather. CPU seconds of the whole rollout, one
thread, after a first one that compiles; the scenarios are those that tune attacks.
"""

from __future__ import annotations

import sys
import time

import torch

from cavbench.core.pair import Pair, choose
from cavbench.core.suites import suite
from cavbench.core.track import Job
from cavbench.driving import ObservationThreat
from cavbench.driving.drive import drive
from cavbench.envs.highway.axes import AXES
from cavbench.errors import in_one_line
from cavbench.scenarios import SeedBlock


def main(name: str, episodes: int) -> None:
    """Print a table."""
    torch.set_num_threads(1)
    parts = {
        "victim": choose("victim", "dqn"),
        "defense": choose("defense", "advtrain"),
        "world": choose("world", "highway"),
        "threat": ObservationThreat(access="dynamics"),
    }
    pairs, _ = suite(name).pairs(**parts)
    cell = AXES.cell(lanes=4, density=1.0)
    seeds = range(SeedBlock.TUNE, SeedBlock.TUNE + episodes)
    for pair in pairs:
        drive(_job(pair, cell, seeds[:1]), ())
    print("| member | CPU s | safe progress | crashed |\n|---|---|---|---|")
    for pair in [pairs[0].clean(), *pairs]:
        start = time.process_time()
        columns = drive(_job(pair, cell, seeds), ()).columns
        cost = time.process_time() - start
        score, crashed = columns["safe_progress"].mean(), columns["crashed"].mean()
        print(f"| {pair.attack} | {cost:.1f} | {score:.2f} | {100 * crashed:.0f} % |", flush=True)


def _job(pair: Pair, cell: object, seeds: range) -> Job:
    draw = getattr(pair.attack.component, "draw", 0)
    return Job(pair=pair, training_seed=0, attack_seed=draw, cell=cell, seeds=seeds)  # type: ignore[arg-type]


if __name__ == "__main__":
    with in_one_line():
        main(sys.argv[1] if len(sys.argv) > 1 else "standard", int(sys.argv[2]) if len(sys.argv) > 2 else 20)
