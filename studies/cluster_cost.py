"""Simulates what the whole leaderboard takes on a cluster, from figures that were measured on two cores:

    python studies/cluster_cost.py
    python studies/cluster_cost.py --cores 16 256 --price 0.02 --driver-ms 3

Every core takes the longest task that is left, sends it back when it is done, and asks for the next one. Tasks are batches as
`bench run` makes them; the work that units of a batch share is left out. The driver does one thing at a time: it sends tasks,
gets outcomes and writes records. Not simulated: slow cores, lost machines, and networks that are too slow for 0.2 MB a unit.
"""

from __future__ import annotations

import argparse
import heapq
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from cavbench.run.batches import EPISODES, TASKS

MEMBERS_S = {
    "none": 0.4,
    "pgd": 6.6,
    "pgd(draw=1)": 7.1,
    "pgd(objective=expected)": 7.3,
    "pgd(objective=target, target_action=0)": 8.8,
    "pgd(objective=target, target_action=2)": 11.3,
    "pgd(objective=target)": 8.6,
    "pgd(objective=target, target_action=4)": 10.3,
    "plan": 15.3,
    "pessimist": 1.3,
    "zo": 4.6,
    "noise": 1.1,
}
"""CPU seconds of a member of the suite on 10 scenarios: `python studies/suite_cost.py standard 10` (4 lanes, density 1)."""
SCENARIOS, BLOCKS = 10, 3
"""Of a unit of standard-v2, and the units of a cell."""
DENSITY_2 = 1.5
"""A unit at density 2 takes so much longer: an assumption, not a measurement."""
VICTIMS, TRAINING_SEEDS, ROADS_AND_WEATHERS = 14, 10, 9
ALONE = ("pessimist",)
"""The members that are not driven in batches."""
DRIVER_MS = 1.0 + 0.1 + 0.3
"""What a unit costs the driver with Ray: the task, its outcome, its records (`benchmarks/executor_speed.py`)."""
WORKER_MS = 2.7
"""What a task costs a worker besides its unit (the same)."""
START_S = 15.0
"""From the command to the first task: imports, the plan, the start of the workers."""


@dataclass(frozen=True)
class Cluster:
    """A number of cores, and what a unit costs besides itself, in seconds."""

    cores: int
    driver_s: float
    worker_s: float


def units() -> Iterator[tuple[str, float]]:
    """Member and CPU seconds of each unit: victims x members of the suite x training seeds x blocks and cells of standard-v2."""
    for member, seconds in MEMBERS_S.items():
        for factor in (1.0, DENSITY_2):
            yield from [(member, seconds * factor)] * (VICTIMS * TRAINING_SEEDS * BLOCKS * ROADS_AND_WEATHERS)


def tasks(cores: int) -> list[tuple[float, int]]:
    """Seconds and number of units of each task, the longest first (`cavbench.run.batches`)."""
    found = []
    counts = Counter(units())
    most = max(1, counts.total() // (TASKS * cores))
    for (member, seconds), count in counts.items():
        size = 1 if member in ALONE else max(1, min(most, EPISODES // SCENARIOS, ROADS_AND_WEATHERS))
        found += [(size * seconds, size)] * (count // size)
        found += [(count % size * seconds, count % size)] * bool(count % size)
    return sorted(found, reverse=True)


def makespan(longest_first: list[tuple[float, int]], cluster: Cluster) -> tuple[float, float]:
    """Seconds from the first task to the last record, and the share of them in which the driver works."""
    free = [0.0] * cluster.cores
    driver = 0.0
    busy = 0.0
    for seconds, count in longest_first:
        asked = heapq.heappop(free)
        # The driver serves those who ask one after the other.
        driver = max(driver, asked) + count * cluster.driver_s
        busy += count * cluster.driver_s
        heapq.heappush(free, driver + cluster.worker_s + seconds)
    end = max(free)
    return end, busy / end


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description="Simulate the whole leaderboard on a cluster.")
    parser.add_argument("--cores", nargs="+", type=int, default=[2, 64, 1000, 4000, 16000])
    parser.add_argument("--price", type=float, default=0.04, help="of a core for an hour")
    parser.add_argument("--driver-ms", type=float, default=DRIVER_MS)
    arguments = parser.parse_args()
    every = [seconds for _, seconds in units()]
    work = sum(every)
    print(f"{len(every)} units, {work / 3600:.0f} CPU hours, the longest unit {max(every):.0f} s\n")
    print(
        "| cores | hours | price | of the cores busy | of the driver busy | units a second |\n|---|---|---|---|---|---|"
    )
    for cores in arguments.cores:
        seconds, driver = makespan(tasks(cores), Cluster(cores, arguments.driver_ms / 1e3, WORKER_MS / 1e3))
        hours = (seconds + START_S) / 3600
        cells = (
            f"{cores}",
            f"{hours:.2f}",
            f"{hours * cores * arguments.price:.0f}",
            f"{100 * work / cores / (seconds + START_S):.0f} %",
            f"{100 * driver:.1f} %",
            f"{len(every) / seconds:.1f}",
        )
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
