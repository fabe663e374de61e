"""Measures what this working tree saves against a commit before it, side by side:

    python benchmarks/commit_speed.py HEAD~1 --defenses smoothing pessimist_q --attacks pgd noise [--units 12] [--decisions 60]

Two processes, one with each code, drive the same units of a few scenarios in turn, as `bench run` does: in one batch if they
may share one. Printed are CPU milliseconds for a decision of an episode, of one thread, and the median of the ratios. The first
round, which compiles, does not count. `same` is the share of the columns of the records that are equal to the last bit.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parents[1]
UNREPEATABLE = ("attack_ms", "redrawn", "same_answer", "inconsistent", "draws")


class Worker:
    """A process that drives with the code of a folder."""

    def __init__(self, folder: Path) -> None:
        subprocess.run(["make", "-s", "tree", "VENV=/nonexist"], cwd=folder, check=True)
        # The folder of this file comes first on a script's path, not that of the package: both are asked for here.
        environment = {**os.environ, "PYTHONPATH": str(folder / "build" / "tree")}
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).resolve()), "--worker"],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __call__(self, **work: Any) -> dict[str, Any]:
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.write(json.dumps(work) + "\n")
        self.process.stdin.flush()
        if not (line := self.process.stdout.readline()):
            raise SystemExit("a worker failed")
        return dict(json.loads(line))

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *given: object) -> None:
        assert self.process.stdin
        self.process.stdin.close()
        self.process.wait()


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit")
    parser.add_argument("--victim", default="dqn")
    parser.add_argument("--defenses", nargs="+", default=["smoothing", "pessimist_q"])
    parser.add_argument("--attacks", nargs="+", default=["pgd", "plan", "rehearse", "zo", "noise"])
    parser.add_argument("--units", type=int, default=12, help="at most 27")
    parser.add_argument("--episodes", type=int, default=10, help="of a unit")
    parser.add_argument("--decisions", type=int, default=60)
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    with ExitStack() as open_ones:
        old = Path(open_ones.enter_context(tempfile.TemporaryDirectory())) / "before"
        subprocess.run(["git", "worktree", "add", "-q", "--detach", str(old), given.commit], cwd=HERE, check=True)
        open_ones.callback(subprocess.run, ["git", "worktree", "remove", "--force", str(old)], cwd=HERE, check=True)
        workers = [open_ones.enter_context(Worker(folder)) for folder in (old, HERE)]
        print("| defence | attack | before, ms | now, ms | before / now | same |\n|---|---|---|---|---|---|")
        for defense, attack in product(given.defenses, given.attacks):
            work = {
                "victim": given.victim,
                "defense": defense,
                "attack": attack,
                "units": given.units,
                "episodes": given.episodes,
                "decisions": given.decisions,
            }
            rounds = [[worker(**work) for worker in workers] for _ in range(given.rounds + 1)][1:]
            before, now = (1e3 * statistics.median(one[side]["seconds"] for one in rounds) for side in (0, 1))
            ratio = statistics.median(one[0]["seconds"] / one[1]["seconds"] for one in rounds)
            ones, others = (rounds[0][side]["columns"] for side in (0, 1))
            same = sum(ones[name] == others[name] for name in ones)
            print(
                f"| {defense} | {attack} | {before:.3f} | {now:.3f} | {ratio:.2f} x | {same} of {len(ones)} |",
                flush=True,
            )


def serve() -> None:
    """Drive what is asked for on standard input, with the code that is on the path."""
    from cavbench.run.process import settle

    settle()
    for line in sys.stdin:
        print(json.dumps(driven(**json.loads(line))), flush=True)


def driven(*, victim: str, defense: str, attack: str, units: int, episodes: int, decisions: int) -> dict[str, Any]:
    """CPU seconds of a decision of an episode, and the columns of the records as text."""
    from cavbench.core.pair import Pair, choose
    from cavbench.core.track import Job
    from cavbench.driving.drive import drive, drive_jointly
    from cavbench.envs.highway.axes import AXES
    from cavbench.envs.highway.world import HighwayWorld
    from cavbench.scenarios import SeedBlock

    driver, world = choose("victim", victim), choose("world", "highway")
    pair = Pair(
        attack=choose("attack", attack),
        defense=choose("defense", defense),
        victim=driver,
        world=replace(world, component=HighwayWorld(max_steps=decisions)),
        threat=driver.component.threat(access="dynamics"),
    )
    cells = [
        AXES.cell(lanes=lanes, density=density, weather=weather)
        for density, weather, lanes in product((1.0, 1.5, 2.0), ("clear", "rain", "fog"), (3, 4, 5))
    ][:units]
    seeds = range(SeedBlock.TUNE, SeedBlock.TUNE + episodes)
    jobs = [Job(pair=pair, training_seed=0, attack_seed=at, cell=cell, seeds=seeds) for at, cell in enumerate(cells)]
    start = time.process_time()
    found = drive_jointly(jobs) or [drive(job, ()) for job in jobs]
    seconds = time.process_time() - start
    columns = {
        name: np.concatenate([one.columns[name] for one in found])
        for name in found[0].columns
        if name not in UNREPEATABLE
    }
    return {
        "seconds": seconds / float(columns["steps"].sum()),
        "columns": {name: column.tobytes().hex() for name, column in columns.items()},
    }


if __name__ == "__main__":
    if sys.argv[1:] == ["--worker"]:
        serve()
    else:
        main()
