"""What filters are worth on a road that bends: a row for each driver and attack, on scenarios that nothing else uses.

    python studies/bent_filters.py [victim:defense ...] [--attacks none pgd rehearse] [--scenarios 20] [--first 4000000]
        [--standing]

`dqn` is the one that ships for the road, training seed 0. Half of the scenarios have density 1, half density 2, with the same
seeds; clear weather. A pair is driven in one batch. Intervals are those of `bench report`, over the seeds. With --standing:
also the share of decisions in which the ego stood, and where: metres driven, the middle half of these decisions.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from cavbench.core.pair import choose
from cavbench.driving import Control, ObservationThreat
from cavbench.driving.rollout import Trace, rollout
from cavbench.errors import in_one_line
from cavbench.run.process import settle
from cavbench.statistics.estimates import share_interval

FRESH = 4_000_000
"""First of the scenario seeds that no test, study or tuning uses but this one."""
PAIRS = ("dqn:none", "dqn:tracker+shield", "planner:none", "planner:tracker")
DENSITIES = (1.0, 2.0)
STANDS = 1.0
"""An ego that is slower stands, in m/s."""


def measured(pair: str, attack: str, scenarios: int, first: int, road: str, *, standing: bool) -> str:
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
    trace = Trace(range(len(cells))) if standing else None
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
        trace=trace,
    )
    score = share_interval(found["safe_progress"].astype(float).reshape(1, len(DENSITIES), -1))
    assured = "" if np.isnan(found["assured"]).all() else f"{np.nanmean(found['assured']):.0%}"
    row = f"| `{name}` | {filtered} | {attack} | {score.estimate:.2f}, {score.low:.2f} to {score.high:.2f} "
    row += f"| {found['crashed'].mean():.0%} | {assured} | {time.process_time() - start:.0f} |"
    return row if trace is None else f"{row} {stood(trace)} |"


def stood(trace: Trace) -> str:
    """The share of decisions in which the ego stood, and the quartiles of the metres that it had driven then."""
    speed, driven, running = (np.stack(trace.steps[name]) for name in ("speed", "x", "running"))
    still = (speed < STANDS) & running
    places = " to ".join(f"{place:.0f}" for place in np.percentile(driven[still], (25, 75))) if still.any() else ""
    return f"{still.sum() / running.sum():.0%}, {places} m"


def main() -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="*", default=PAIRS)
    parser.add_argument("--attacks", nargs="+", default=["none", "pgd", "rehearse", "noise"])
    parser.add_argument("--scenarios", type=int, default=20)
    parser.add_argument("--first", type=int, default=FRESH)
    parser.add_argument("--road", default="u_turn")
    parser.add_argument("--standing", action="store_true")
    given = parser.parse_args()
    settle()
    names = ("victim", "filter", "attack", "safe progress", "crashed", "assured", "CPU s")
    names += ("stood",) * given.standing
    print(f"| {' | '.join(names)} |\n{'|---' * len(names)}|", flush=True)
    for attack in given.attacks:
        for pair in given.pairs:
            print(measured(pair, attack, given.scenarios, given.first, given.road, standing=given.standing), flush=True)


if __name__ == "__main__":
    with in_one_line():
        main()
