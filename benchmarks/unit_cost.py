"""Measures what a unit of driving costs besides the victim's network:

    python benchmarks/unit_cost.py [--attacks zo noise pgd] [--victim dqn] [--episodes 20] [--units 3] [--rounds 1]

Prints the CPU time of units in one thread as a ratio to the victim's forward passes alone, with the same number of observations
in batches of a thousand; a query with a gradient counts as a forward and a backward pass. `alone` drives the units one by one,
`together` in batches, as `bench run` does. Everything is measured alternately in one process, against an adversarially trained
victim, on scenarios that tune attacks. Each round uses the CPU seconds of that round; the median of the ratios is printed.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from itertools import product

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.pair import Pair, choose
from cavbench.core.track import Driven, Job
from cavbench.driving import Policy
from cavbench.driving.drive import drive, drive_jointly
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import in_one_line
from cavbench.run.batches import EPISODES
from cavbench.run.process import settle
from cavbench.scenarios import SeedBlock

AT_ONCE = 1000


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--attacks", nargs="+", default=["zo", "noise", "pgd"])
    parser.add_argument("--victim", default="dqn")
    parser.add_argument("--episodes", type=int, default=20, help="episodes of a unit")
    parser.add_argument("--units", type=int, default=3, help="units of each density, at most 9")
    parser.add_argument("--rounds", type=int, default=1)
    arguments = parser.parse_args()
    settle()
    print(
        "| attack | density | forward, µs | alone, µs | together, µs | alone | together |\n|---|---|---|---|---|---|---|"
    )
    for attack in arguments.attacks:
        pair = _pair(attack, arguments.victim)
        policy = pair.load(0)
        for density in (1.0, 2.0):
            jobs = _jobs(pair, density, arguments.episodes)[: arguments.units]
            drive(_jobs(pair, density, 1)[0], ())
            rounds = [_round(jobs, policy) for _ in range(arguments.rounds)]
            forward, alone, together = map(statistics.median, zip(*rounds, strict=True))
            ratios = [statistics.median(one[at] / one[0] for one in rounds) for at in (1, 2)]
            cells = [f"{1e6 * value:.2f}" for value in (forward, alone, together)] + [
                f"{value:.2f} x" for value in ratios
            ]
            print(f"| {attack} | {density:g} | {' | '.join(cells)} |", flush=True)


def _pair(attack: str, victim: str) -> Pair:
    found = choose("victim", victim)
    return Pair(
        attack=choose("attack", attack),
        defense=choose("defense", "advtrain"),
        victim=found,
        world=choose("world", "highway"),
        threat=found.component.threat(),
    )


def _jobs(pair: Pair, density: float, episodes: int) -> list[Job]:
    seeds = range(SeedBlock.TUNE, SeedBlock.TUNE + episodes)
    cells = [
        AXES.cell(lanes=lanes, density=density, weather=weather)
        for weather, lanes in product(("clear", "rain", "fog"), (3, 4, 5))
    ]
    return [Job(pair=pair, training_seed=0, attack_seed=at, cell=cell, seeds=seeds) for at, cell in enumerate(cells)]


def _round(jobs: Sequence[Job], policy: Policy) -> tuple[float, float, float]:
    """CPU seconds for each observation that the victim is shown: of its passes alone, of units alone, of units together."""
    driven: list[Driven] = []
    alone = _seconds(lambda: driven.extend(drive(job, ()) for job in jobs))
    size = max(1, EPISODES // len(jobs[0].seeds))
    shared = [jobs[start : start + size] for start in range(0, len(jobs), size)]
    together = _seconds(lambda: [drive_jointly(some) or [drive(job, ()) for job in some] for some in shared])
    steps = sum(float(one.columns["steps"].sum()) for one in driven)
    queries, gradients = (
        sum(float((one.columns[name] * one.columns["steps"]).sum()) for one in driven)
        for name in ("queries", "gradient_queries")
    )
    # In every step the victim drives, and decides on the truth once more for `changed`.
    evaluations = queries + 2 * steps
    observation = _observations(AT_ONCE)
    forward, both = _each(policy, observation, False), _each(policy, observation, True) if gradients else 0.0
    passes = ((evaluations - gradients) * forward + gradients * both) / evaluations
    return passes, alone / evaluations, together / evaluations


def _observations(count: int) -> Tensor:
    env = HighwayWorld().make([AXES.cell(lanes=4, density=2.0)] * count)
    seeds = torch.arange(SeedBlock.TUNE, SeedBlock.TUNE + count)
    found: Tensor = env.reset(TensorDict({"seed": seeds}, batch_size=env.batch_size))["observation"]
    return found


def _each(policy: Policy, observation: Tensor, gradient: bool, repeats: int = 200) -> float:
    """CPU seconds for one observation of a batch: of a forward pass, or of a forward and a backward pass."""

    def work() -> None:
        for _ in range(repeats):
            with torch.set_grad_enabled(gradient):
                asked = observation.clone().requires_grad_(gradient)
                scores = policy.scores(asked)
                if gradient:
                    torch.autograd.grad(scores.sum(), asked)

    return _seconds(work) / repeats / len(observation)


def _seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


if __name__ == "__main__":
    with in_one_line():
        main()
