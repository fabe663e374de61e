"""What `rival` does beside an untrained one, chance, and the rules that drive traffic: the table of docs/attacks/rival.md.

python studies/rival.py VICTIM:DEFENSE [...] [--scenarios 40] [--cars 1] [--attacks cut_in brake_check]

All roads of the grid in clear weather, the same scenarios for all. They are of the tuning block: no training used them, and no
report has them. Each row has the score, the share of the episodes that end in a crash that could have been avoided, and by how
much more of them `rival` does so: the paired difference, with 95 % intervals.
"""

from __future__ import annotations

import argparse
import time
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.attacks.driving.rival import Rival
from cavbench.attacks.driving.rival_seat import ACTIONS, FEATURES
from cavbench.core.pair import choose
from cavbench.driving import Control, DrivingAttack, Policy
from cavbench.driving.blame import AVOIDABLE
from cavbench.driving.rollout import rollout
from cavbench.driving.sets import Traffic
from cavbench.driving.threat import ObservationThreat
from cavbench.driving.victims.networks import QPolicy
from cavbench.driving.victims.practice import roads
from cavbench.scenarios import SeedBlock
from cavbench.statistics.estimates import interval, share_interval

FIRST = SeedBlock.TUNE + 20_000
"""The first scenario: none of those from here on was looked at while the training was written."""


class Chance(Policy):
    """Makes every choice with the same probability."""

    action_type = "discrete"

    def forward(self, observation: Tensor) -> Tensor:
        return torch.rand(*observation.shape[:-2], ACTIONS)


def measured(
    subject: str, attacks: dict[str, DrivingAttack], scenarios: int, cars: int
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]]:
    """Of each attack the score, the crashes and the avoidable crashes, [1, C, E] each, and the CPU seconds."""
    name, defense = subject.split(":")
    world, victim = choose("world", "highway").component, choose("victim", name).component
    policy = choose("defense", defense).component.load(victim, 0, world.facts)
    places, traffic = roads(world, scenarios), Traffic(cars=cars)
    seeds = [FIRST + number % scenarios for number in range(len(places))]
    control = Control(action_type=victim.action_type, driver=victim.driver, traffic=traffic)
    found = {}
    for title, attack in attacks.items():
        start = time.process_time()
        columns = rollout(
            world.build(places, control),
            policy,
            attack,
            ObservationThreat(budget=0.0, access="dynamics", traffic=traffic),
            seeds,
            facts=world.facts,
            attack_seed=0,
            dynamics=world.dynamics(places, victim.action_type),
            judge=partial(world.blame, places, control),
        )
        avoidable = columns["crashed"] * (np.nan_to_num(columns[AVOIDABLE]) > 0)
        score, crashed, avoidable = (
            np.asarray(values, float).reshape(1, -1, scenarios)
            for values in (columns["safe_progress"], columns["crashed"], avoidable)
        )
        found[title] = score, crashed, avoidable, time.process_time() - start
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("subjects", nargs="+")
    parser.add_argument("--scenarios", type=int, default=40)
    parser.add_argument("--cars", type=int, default=1)
    parser.add_argument("--attacks", nargs="*", default=["cut_in", "brake_check"])
    given = parser.parse_args()
    facts = choose("world", "highway").component.facts
    for subject in given.subjects:
        victim, defense = (
            choose(kind, name).component for kind, name in zip(("victim", "defense"), subject.split(":"), strict=True)
        )
        torch.manual_seed(0)
        attacks: dict[str, DrivingAttack] = {
            "rival": Rival().armed(Rival().load(victim, defense, 0, facts)),
            "untrained": Rival().armed(QPolicy(FEATURES, ACTIONS, Rival().hidden).eval()),
            "chance": Rival().armed(Chance().eval()),
            **{name: choose("attack", name).component for name in given.attacks},
        }
        found = measured(subject, attacks, given.scenarios, given.cars)
        for title, (score, crashed, avoidable, seconds) in found.items():
            rate, less = share_interval(avoidable), interval(found["rival"][2] - avoidable)
            print(
                f"{subject:20} {title:12} score {score.mean():.2f} crashed {crashed.mean():.2f} avoidable {rate.estimate:.2f} "
                f"({rate.low:.2f} to {rate.high:.2f}) rival more by {less.estimate:.2f} ({less.low:.2f} to {less.high:.2f}) "
                f"CPU {seconds:.0f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
