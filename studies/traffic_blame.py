"""What driven cars do to drivers, and who is to blame: the table of docs/traffic.md.

python studies/traffic_blame.py [attack:victim:defense ...] [--scenarios 12] [--cells 3x2 5x2] [--gap 3] [--headway 0.1]
    [--closing 8] [--each]

With --each: also how often RSS (`room`) and the replays lay the blame on the same side.
"""

from __future__ import annotations

import argparse
import time
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cavbench.core.pair import choose
from cavbench.driving import Control
from cavbench.driving.blame import COLUMNS
from cavbench.driving.rollout import rollout
from cavbench.driving.sets import Traffic
from cavbench.driving.threat import ObservationThreat
from cavbench.envs.highway.axes import AXES
from cavbench.scenarios import SeedBlock

Blame = NDArray[np.float64]
"""[3, crashes] of `COLUMNS`."""
CARS = {"box_in": 3}
PAIRS = (
    "cut_in:clairvoyant:none",
    "brake_check:clairvoyant:none",
    "box_in:clairvoyant:none",
    "cut_in:planner:tracker",
    "brake_check:planner:tracker",
    "box_in:planner:tracker",
    "cut_in:idm:none",
    "brake_check:idm:none",
    "box_in:idm:none",
    "reckless:planner:tracker",
    "cut_in:dqn:tracker+shield",
    "brake_check:dqn:tracker+shield",
    "box_in:dqn:tracker+shield",
    "reckless:dqn:tracker+shield",
)


def measured(pair: str, cells: list[str], scenarios: int, bounds: dict[str, float]) -> tuple[str, Blame]:
    """One row of the table, on scenarios that are never reported, and the judgements of its crashes."""
    attack, victim, defense = pair.split(":")
    world, driver, adversary = (
        choose(kind, name).component for kind, name in (("world", "highway"), ("victim", victim), ("attack", attack))
    )
    roads = [tuple(map(int, cell.split("x"))) for cell in cells for _ in range(scenarios)]
    places = [AXES.cell(lanes=lanes, density=float(density)) for lanes, density in roads]
    seeds = [SeedBlock.TUNE + number for _ in cells for number in range(scenarios)]
    facts = world.facts_at(places[0])
    policy = driver.load(0, facts) if defense == "none" else choose("defense", defense).component.load(driver, 0, facts)
    traffic = Traffic(cars=CARS.get(attack, 1), **bounds)
    control = Control(action_type=driver.action_type, driver=driver.driver, traffic=traffic)
    start = time.process_time()
    found = rollout(
        world.build(places, control),
        policy,
        adversary,
        ObservationThreat(budget=0.0, access="dynamics", traffic=traffic),
        seeds,
        facts=facts,
        attack_seed=0,
        dynamics=world.dynamics(places, driver.action_type),
        judge=partial(world.blame, places, control),
    )
    crashed = found["crashed"]
    shares = [f"{name} {np.nanmean(found[name][crashed]) if crashed.any() else np.nan:.2f}" for name in COLUMNS]
    row = (
        f"{attack:12} {victim + ' ' + defense:22} score {found['safe_progress'].mean():.2f} crashed {crashed.sum()}/"
        f"{len(crashed)} {' '.join(shares)} CPU {time.process_time() - start:.0f} s"
    )
    return row, np.stack([found[name][crashed] for name in COLUMNS])


def both_ways(crashes: Blame) -> str:
    """How often RSS and the replays agree about who could have avoided a crash; of the crashes that both judge."""
    avoidable, by_idm, room = crashes[:, np.isfinite(crashes).all(0)]
    rows = {
        "avoidable": avoidable == 1,
        "unavoidable": avoidable == 0,
        "IDM avoids": by_idm == 1,
        "IDM does not": by_idm == 0,
    }
    return "\n".join(
        f"{name}: {chosen.sum()} crashes, {(room[chosen] < 1).sum()} with room below 1; room "
        f"{np.sort(room[chosen]).round(2).tolist()}"
        for name, chosen in rows.items()
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pairs", nargs="*", default=PAIRS)
    parser.add_argument("--scenarios", type=int, default=12)
    parser.add_argument("--cells", nargs="+", default=["3x2", "5x2"])
    for name, value in (("gap", 3.0), ("headway", 0.1), ("closing", 8.0)):
        parser.add_argument(f"--{name}", type=float, default=value)
    parser.add_argument("--each", action="store_true")
    given = parser.parse_args()
    bounds = {name: getattr(given, name) for name in ("gap", "headway", "closing")}
    crashes = []
    for pair in given.pairs:
        row, judged = measured(pair, given.cells, given.scenarios, bounds)
        crashes.append(judged)
        print(row, flush=True)
    if given.each:
        print(both_ways(np.concatenate(crashes, 1)))


if __name__ == "__main__":
    main()
