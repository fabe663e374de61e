"""Measures what a unit under a fault costs, as a ratio to the same unit without one:

    python benchmarks/faults_cost.py [--victim dqn] [--defense none] [--episodes 20] [--rounds 3] [--severity 2]
        [--modes ghosts noise]

CPU seconds of a unit, and for each frame of its batch, since episodes end earlier under a fault. Both are driven alternately in
one process and one thread, on scenarios that tune attacks. The medians of the ratios of the rounds are printed.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import replace

from cavbench.core import sets, suites
from cavbench.core.pair import Pair, choose
from cavbench.core.track import Job
from cavbench.driving import ObservationThreat
from cavbench.driving.drive import drive
from cavbench.envs.highway.axes import AXES
from cavbench.errors import in_one_line
from cavbench.run.process import settle
from cavbench.scenarios import SeedBlock

ALLOWED = ObservationThreat(
    norm="linf",
    access="oblivious",
    presence={"hidden": 9, "invented": 3},  # type: ignore[arg-type]
    latency={"frames": 4},  # type: ignore[arg-type]
    held={"share": 0.5, "longest": 15},  # type: ignore[arg-type]
    actuator={"delay": 4, "replaced": 0.5},  # type: ignore[arg-type]
)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--victim", default="dqn")
    parser.add_argument("--defense", default="none")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--severity", type=int, default=2)
    parser.add_argument("--modes", nargs="*")
    arguments = parser.parse_args()
    settle()
    pair = Pair(
        attack=choose("attack", "fault"),
        defense=choose("defense", arguments.defense),
        victim=choose("victim", arguments.victim),
        world=choose("world", "highway"),
        threat=replace(ALLOWED, norm="linf"),
    )
    clean = pair.clean()
    _cost(clean, 2)
    print("| fault | unit | frame |\n|---|---|---|")
    ratios = []
    for member in suites.suite("faults").members:
        mode = member.params["mode"]
        if member.params["severity"] != arguments.severity or mode not in (arguments.modes or [mode]):
            continue
        attacked = replace(pair, attack=member.chosen, threat=sets.widened(pair.threat, member.threat))
        rounds = [
            (_cost(attacked, arguments.episodes), _cost(clean, arguments.episodes)) for _ in range(arguments.rounds)
        ]
        unit, frame = (statistics.median(one[at] / two[at] for one, two in rounds) for at in (0, 1))
        ratios.append((unit, frame))
        print(f"| {mode} | {unit:.2f} x | {frame:.2f} x |", flush=True)
    print("| mean | " + " | ".join(f"{statistics.mean(values):.2f} x" for values in zip(*ratios, strict=True)) + " |")


def _cost(pair: Pair, episodes: int) -> tuple[float, float]:
    """CPU seconds of a unit, and of a frame of its batch."""
    seeds = range(SeedBlock.TUNE, SeedBlock.TUNE + episodes)
    job = Job(
        pair=pair, training_seed=0, attack_seed=0, cell=AXES.cell(lanes=3, density=1.0, weather="clear"), seeds=seeds
    )
    start = time.process_time()
    driven = drive(job, ())
    spent = time.process_time() - start
    return spent, spent / float(driven.columns["steps"].max())


if __name__ == "__main__":
    with in_one_line():
        main()
