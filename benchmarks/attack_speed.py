"""Measures how much faster the batched ZO-SignSGD is than the sequential algorithm of the thesis:

    python benchmarks/attack_speed.py [--episodes 128] [--steps 100] [--directions 20] [--rounds 3]

Both attack the same network with the same number of queries, alternately, in one process and one thread. The sequential version
follows Algorithm 4: one environment, one direction and one query at a time. The result is the wall time of one attacked step of
one episode. A second line measures the attack with the defaults of `bench run attack=zo`.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.attacks.driving.zo import ZOSignSGD
from cavbench.driving import DrivingAttack, ObservationThreat, Policy
from cavbench.driving.attacker import Attacker
from cavbench.driving.victim import CountedPolicy
from cavbench.driving.victims.networks import QPolicy
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import in_one_line
from cavbench.run.process import settle
from cavbench.scenarios import SeedBlock

SMOOTHING, STEP_SIZE, FASTER = 0.01, 0.01, 3


class SequentialZO:
    """Algorithm 4 of the thesis: unconstrained, Eq. 4.10 towards FASTER, with no more tensor operations than it needs."""

    def __init__(self, policy: Policy, steps: int, directions: int) -> None:
        self.policy, self.steps, self.directions = policy, steps, directions
        self.queries = 0

    def loss(self, x: Tensor, observation: Tensor) -> Tensor:
        """Eq. 4.10; one query."""
        self.queries += 1
        scores = self.policy.scores(x)
        return (scores.amax() - scores[FASTER]).abs() + ((x - observation) ** 2).norm()

    def estimate(self, x: Tensor, observation: Tensor) -> Tensor:
        """GradEstimate(x, mu, q, d)."""
        gradient, base = torch.zeros_like(x), self.loss(x, observation)
        for _ in range(self.directions):
            u = torch.randn(x.shape)
            u = u / u.norm()
            gradient += x.numel() * (self.loss(x + SMOOTHING * u, observation) - base) / SMOOTHING * u
        return gradient

    def perturb(self, observation: Tensor) -> Tensor:
        """optimization(x) for one observation [V, F]."""
        x = observation
        for _ in range(self.steps):
            x = x - STEP_SIZE * self.estimate(x, observation).sign()
        return x


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--episodes", type=int, default=128, help="batch size of the batched attack")
    parser.add_argument("--steps", type=int, default=100, help="iterations T of both attacks")
    parser.add_argument("--directions", type=int, default=20, help="random directions q of both attacks")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    settle()
    torch.manual_seed(0)
    world, policy = HighwayWorld(), QPolicy(5, 5, 64).requires_grad_(False).eval()
    observation = _observations(world, arguments.episodes)
    same = ZOSignSGD(objective="thesis", steps=arguments.steps, directions=arguments.directions, early_stop=False)
    batched = _batched(same, policy, world, observation)
    usual = _batched(ZOSignSGD(), policy, world, observation)
    loop = SequentialZO(policy, arguments.steps, arguments.directions)
    seconds: dict[str, list[float]] = {"loop": [], "batched": [], "usual": []}
    for index in range(arguments.rounds + 1):
        alone = observation[index % arguments.episodes]
        taken = {
            "loop": _timed(lambda alone=alone: loop.perturb(alone)),  # type: ignore[misc]
            "batched": _timed(batched) / arguments.episodes,
            "usual": _timed(usual) / arguments.episodes,
        }
        for name, value in taken.items():
            seconds[name].append(value)
    # The first round warms up the caches.
    milliseconds = {name: statistics.median(values[1:]) * 1000 for name, values in seconds.items()}
    queries = arguments.steps * (arguments.directions + 1)
    print(f"one attacked step of one episode, median of {arguments.rounds} alternating rounds, one thread")
    print(f"  sequential, {queries} queries           {milliseconds['loop']:10.3f} ms")
    for name, what in (("batched", f"{queries} queries"), ("usual", "attack=zo")):
        label = f"batch of {arguments.episodes}, {what}"
        print(
            f"  {label:<30}  {milliseconds[name]:10.3f} ms   {milliseconds['loop'] / milliseconds[name]:6.0f} times faster"
        )


def _observations(world: HighwayWorld, episodes: int) -> Tensor:
    """The first observations [episodes, V, F] of some episodes."""
    env = world.make([AXES.cell(lanes=3, density=1.0)] * episodes)
    seeds = torch.arange(SeedBlock.TUNE, SeedBlock.TUNE + episodes)
    observation: Tensor = env.reset(TensorDict({"seed": seeds}, batch_size=env.batch_size))["observation"]
    return observation


def _batched(attack: DrivingAttack, policy: Policy, world: HighwayWorld, observation: Tensor) -> Callable[[], object]:
    """One step of an attack as in a run, with the oracle and its checks."""
    attacker = Attacker(attack, CountedPolicy(policy), ObservationThreat(queries=1_000_000), world.features, seed=0)
    running = torch.ones(len(observation), dtype=torch.bool)
    return lambda: attacker.show(observation, running, None)


def _timed(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


if __name__ == "__main__":
    with in_one_line(), torch.no_grad():
        main()
