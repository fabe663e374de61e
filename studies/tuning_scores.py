"""Scores on the tuning seeds, which are never reported: `python studies/tuning_scores.py victim=planner episodes=16`.

Takes the options of `bench run` that choose pairs, cells, training seeds and episodes, and keeps no records.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np

from cavbench.driving.drive import drive
from cavbench.errors import in_one_line
from cavbench.run.config import plan_of
from cavbench.run.process import settle
from cavbench.run.unit import Unit
from cavbench.scenarios import SeedBlock


def main() -> None:
    settle()
    config = plan_of([*sys.argv[1:], "reference=false"])
    grid = replace(config.grid, first_seed=SeedBlock.TUNE)
    for pair in config.pairs:
        start, cells = time.process_time(), []
        for cell in grid.cells():
            units = [
                Unit(pair=pair, training_seed=seed, weights_sha256="", cell=cell, seeds=grid.seeds())
                for seed in (config.seeds if pair.is_seeded else (0,))
            ]
            columns = [drive(unit.job, ()).columns for unit in units]
            cells.append(
                [np.mean([each[name] for each in columns]) for name in ("safe_progress", "crashed", "assured")]
            )
            print(f"  {cell}: {cells[-1][0]:.3f}, crashed {cells[-1][1]:.0%}", flush=True)
        score, crashed, assured = np.mean(cells, 0)
        seconds = time.process_time() - start
        print(f"{pair}: {score:.3f}, crashed {crashed:.1%}, assured {assured:.1%}, {seconds:.0f} CPU s", flush=True)


if __name__ == "__main__":
    with in_one_line():
        main()
