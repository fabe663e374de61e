"""What filters are worth on a road that bends: a row for each driver and attack, on scenarios that nothing else uses.

    python studies/bent_filters.py [victim:defense ...] [--attacks none pgd rehearse] [--scenarios 20] [--first 4000000]

`dqn` is the one that ships for the road, training seed 0. Half of the scenarios have density 1, half density 2, with the same
seeds; clear weather. A pair is driven in one batch. Intervals are those of `bench report`, over the seeds.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from cavbench.core.pair import choose
from cavbench.driving import Control, ObservationThreat
from cavbench.driving.rollout import rollout
from cavbench.errors import in_one_line
from cavbench.run.process import settle
from cavbench.statistics.estimates import share_interval

FRESH = 4_000_000
"""First of the scenario seeds that no test, study or tuning uses but this one."""
PAIRS = ("dqn:none", "dqn:tracker+shield", "planner:none", "planner:tracker")
DENSITIES = (1.0, 2.0)


def measured(pair: str, attack: str, scenarios: int, first: int, road: str) -> str:
    """One row of the table."""
    name, filtered = pair.split(":")
    world = choose("world", road).component
    home = {"decisions": 12000, "trained_in": road} if name == "dqn" else {}
    victim = choose("victim", name, **home).component
    facts = world.facts
    policy = (
        victim.load(0, facts) if filtered == "none" else choose("defense", filtered).component.load(victim, 0, facts)
    )
    cells = [world.axes.cell(density=density) for density in DENSITIES for _ in range(scenarios // 2)]
    start = time.process_time()
    found = rollout(
        world.build(cells, Control()),
        policy,
        None if attack == "none" else choose("attack", attack).component,
        ObservationThreat(access="dynamics"),
        [first + number for _ in DENSITIES for number in range(scenarios // 2)],
        facts=facts,
        attack_seed=0,
        dynamics=world.dynamics(cells, "discrete"),
    )
    score = share_interval(found["safe_progress"].astype(float).reshape(1, len(DENSITIES), -1))
    assured = "" if np.isnan(found["assured"]).all() else f"{np.nanmean(found['assured']):.0%}"
    row = f"| `{name}` | {filtered} | {attack} | {score.estimate:.2f}, {score.low:.2f} to {score.high:.2f} "
    return row + f"| {found['crashed'].mean():.0%} | {assured} | {time.process_time() - start:.0f} |"


def main() -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="*", default=PAIRS)
    parser.add_argument("--attacks", nargs="+", default=["none", "pgd", "rehearse", "noise"])
    parser.add_argument("--scenarios", type=int, default=20)
    parser.add_argument("--first", type=int, default=FRESH)
    parser.add_argument("--road", default="u_turn")
    given = parser.parse_args()
    settle()
    print(
        "| victim | filter | attack | safe progress | crashed | assured | CPU s |\n|---|---|---|---|---|---|---|",
        flush=True,
    )
    for attack in given.attacks:
        for pair in given.pairs:
            print(measured(pair, attack, given.scenarios, given.first, given.road), flush=True)


if __name__ == "__main__":
    with in_one_line():
        main()
