"""Measures what compiled networks and filters save against torch:

    python benchmarks/compiled_speed.py [--attacks pgd zo rehearse] [--defense advtrain] [--episodes 20] [--rounds 3]
    python benchmarks/compiled_speed.py --part filter --defense tracker+shield --attacks pgd rehearse
    python benchmarks/compiled_speed.py --part belief --defense pessimist_q --attacks pgd
    python benchmarks/compiled_speed.py --part rules --victim planner --defense tracker --attacks pgd

Prints the CPU time of a pass of the victim, forward and with its gradient, and of whole units, each as torch's over that of the
compiled code. Both are measured alternately in one process and one thread, on scenarios that tune attacks; the median of the
ratios of the rounds is printed.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from unittest.mock import patch

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.pair import Pair, choose
from cavbench.core.track import Job
from cavbench.driving import Policy, State
from cavbench.driving.drive import drive
from cavbench.driving.fused.network import Fused
from cavbench.driving.intervals.belief import Belief
from cavbench.driving.intervals.mask import Mask
from cavbench.driving.intervals.worth import Worth
from cavbench.driving.policy import repeated
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import in_one_line
from cavbench.run.process import settle
from cavbench.scenarios import SeedBlock

PARTS = {"network": Fused, "filter": Mask, "belief": Belief, "rules": Worth}
SIZES = (20, 40, 160, 720, 1600)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--attacks", nargs="*", default=["pgd", "zo", "rehearse"])
    parser.add_argument("--victim", default="dqn")
    parser.add_argument("--defense", default="advtrain")
    parser.add_argument("--episodes", type=int, default=20, help="episodes of a unit")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--part", choices=PARTS, default="network", help="what torch computes in turn")
    arguments = parser.parse_args()
    settle()
    part = PARTS[arguments.part]
    print("| what | torch, ms | compiled, ms | torch / compiled |\n|---|---|---|---|")
    policy = _pair("none", arguments.defense, arguments.victim).load(0)
    for size in SIZES:
        for gradient in (False, True):
            work = _queries(policy, size, gradient)
            name = f"{size} points{', with their gradient' if gradient else ''}"
            _line(name, work, part, arguments.rounds, max(1, 4000 // size))
    for attack in arguments.attacks:
        pair = _pair(attack, arguments.defense, arguments.victim)
        job = _job(pair, arguments.episodes)
        _line(f"a unit of {attack}", lambda job=job: drive(job, ()), part, arguments.rounds, 1)  # type: ignore[misc]


def _line(name: str, work: Callable[[], object], part: type, rounds: int, repeats: int) -> None:
    """Print the CPU times of torch and of the compiled code, measured in turn, and the median of their ratios."""

    def seconds() -> float:
        start = time.process_time()
        for _ in range(repeats):
            work()
        return (time.process_time() - start) / repeats

    work()
    pairs = []
    for _ in range(rounds):
        with patch.object(part, "fits", lambda self, *given: False):
            torch_s = seconds()
        pairs.append((torch_s, seconds()))
    before, after = (1000 * statistics.median(side) for side in zip(*pairs, strict=True))
    ratio = statistics.median(one / other for one, other in pairs)
    print(f"| {name} | {before:.3f} | {after:.3f} | {ratio:.2f} x |", flush=True)


def _pair(attack: str, defense: str, victim: str) -> Pair:
    found = choose("victim", victim)
    return Pair(
        attack=choose("attack", attack),
        defense=choose("defense", defense),
        victim=found,
        world=choose("world", "highway"),
        threat=found.component.threat(access="dynamics"),
    )


def _job(pair: Pair, episodes: int) -> Job:
    seeds = range(SeedBlock.TUNE, SeedBlock.TUNE + episodes)
    return Job(pair=pair, training_seed=0, attack_seed=0, cell=AXES.cell(lanes=4, density=2.0), seeds=seeds)


def _queries(policy: Policy, count: int, gradient: bool) -> Callable[[], object]:
    """A query at `count` points, with the state of the victim after a few decisions."""
    episodes = 20
    observation, state = _driven(policy, episodes)
    copies = -(-count // episodes)
    points = observation.expand(copies, *observation.shape).flatten(0, 1)[:count].clone()
    memory = repeated(state, torch.Size([copies]))
    memory = None if memory is None else memory[:count]

    def work() -> None:
        with torch.set_grad_enabled(gradient):
            asked = points.clone().requires_grad_(gradient)
            scores = policy.scores(asked, memory)
            if gradient:
                torch.autograd.grad(scores, asked, torch.ones_like(scores))

    return work


def _driven(policy: Policy, episodes: int, steps: int = 5) -> tuple[Tensor, State]:
    """Observations [episodes, V, F] after a few decisions, and the victim's state."""
    env = HighwayWorld().make([AXES.cell(lanes=4, density=2.0)] * episodes)
    seeds = torch.arange(SeedBlock.TUNE, SeedBlock.TUNE + episodes)
    with torch.no_grad():
        td = env.reset(TensorDict({"seed": seeds}, batch_size=env.batch_size))
        state = policy.initial(torch.arange(episodes))
        for _ in range(steps):
            action = policy.decide(td["observation"], state)
            state = policy.advance(td["observation"], action, state)
            td = env.step(td.set("action", action))["next"]
    return td["observation"], state


if __name__ == "__main__":
    with in_one_line():
        main()
