"""Measures how much faster than highway-env the driving world is, per CPU second of one thread:

    python benchmarks/highway_speed.py [--rounds 9] [--steps 50] [--vehicles 20 50] [--batch 64 1024]

Every round drives highway-env, the engine and the TorchRL environment through the same part of the episodes, so that other load
on the machine affects all three. 3 lanes, density 1, 15 Hz. highway-env's IDM driver drives the ego in all three and keeps it
in traffic: an ego that only brakes would soon be alone, a random one would crash.
Compilation is not counted. A TorchRL step is `step_and_maybe_reset`, which also prepares the tensordict of the next step and
resets finished episodes, as a collector does.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from tensordict import TensorDict

from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.batched import BatchedHighway
from cavbench.envs.highway.config import ACTIONS, HighwayConfig
from cavbench.envs.highway.engine import HighwayEngine
from cavbench.envs.highway.reference import SensedHighwayEnv
from cavbench.scenarios import SeedBlock

CELL = AXES.cell(lanes=3, density=1.0)
IDLE = ACTIONS.index("IDLE")
ENGINE_GOAL, ENVIRONMENT_GOAL = 700, 500


@dataclass
class Contender:
    """One of the compared simulators: `drive(steps)` returns the number of episode steps that it drove."""

    drive: Callable[[int], int]
    done: int = 0
    seconds: float = 0.0
    rounds: list[float] = field(default_factory=list)

    def measure(self, steps: int) -> None:
        """Drive some steps and add their CPU time."""
        start = time.process_time()
        done = self.drive(steps)
        seconds = time.process_time() - start
        self.done += done
        self.seconds += seconds
        self.rounds.append(done / seconds)

    @property
    def rate(self) -> float:
        """Episode steps per CPU second."""
        return self.done / self.seconds


def highway_env(vehicles: int) -> Contender:
    """highway-env itself, one episode."""
    env = SensedHighwayEnv(HighwayConfig(cells=(CELL,), vehicles=vehicles, driver="idm"), CELL)
    env.start(int(SeedBlock.TUNE))

    def drive(steps: int) -> int:
        for _ in range(steps):
            env.decide(None)
        return steps

    return Contender(drive)


def engine(vehicles: int, batch: int) -> Contender:
    """The compiled engine without TorchRL."""
    simulator = HighwayEngine(HighwayConfig(cells=(CELL,) * batch, vehicles=vehicles, driver="idm", max_steps=10**9))
    simulator.reset(np.arange(batch), int(SeedBlock.TUNE) + np.arange(batch))
    action = np.full(batch, IDLE)

    def drive(steps: int) -> int:
        before = int(simulator.episodes["steps"].sum())
        for _ in range(steps):
            simulator.step(action)
        return int(simulator.episodes["steps"].sum()) - before

    return Contender(drive)


def environment(vehicles: int, batch: int) -> Contender:
    """The TorchRL environment of the engine."""
    env = BatchedHighway(HighwayConfig(cells=(CELL,) * batch, vehicles=vehicles, driver="idm"))
    seeds = int(SeedBlock.TUNE) + torch.arange(batch)
    state = env.reset(TensorDict({"seed": seeds}, batch_size=[batch]))
    action = torch.full((batch,), IDLE)

    def drive(steps: int) -> int:
        nonlocal state
        for _ in range(steps):
            state["action"] = action
            _, state = env.step_and_maybe_reset(state)
        return steps * batch

    return Contender(drive)


def compare(vehicles: int, batches: tuple[int, ...], rounds: int, steps: int) -> list[list[str]]:
    """The rows of the table for one number of vehicles."""
    farama = highway_env(vehicles)
    pairs = [(batch, engine(vehicles, batch), environment(vehicles, batch)) for batch in batches]
    for contender in (farama, *(c for _, *both in pairs for c in both)):
        contender.drive(1)
    for _ in range(rounds):
        farama.measure(steps)
        for _, ours, torchrl in pairs:
            ours.measure(steps)
            torchrl.measure(steps)
    return [
        [
            str(vehicles),
            str(batch),
            f"{farama.rate:.0f}",
            f"{ours.rate:,.0f}",
            *ratio(ours, farama, ENGINE_GOAL),
            f"{torchrl.rate:,.0f}",
            *ratio(torchrl, farama, ENVIRONMENT_GOAL),
        ]
        for batch, ours, torchrl in pairs
    ]


def ratio(ours: Contender, farama: Contender, goal: int) -> tuple[str, str]:
    """The ratio of the rates (green if it reaches the goal), and its range over the rounds."""
    value = ours.rate / farama.rate
    ratios = [a / b for a, b in zip(ours.rounds, farama.rounds, strict=True)]
    colour = "green" if value >= goal else "red"
    return f"[{colour}]{value:,.0f} x[/{colour}]", f"{min(ratios):,.0f}-{max(ratios):,.0f}"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--rounds", type=int, default=9, help="rounds per configuration (9 rounds of 50 steps are one episode)"
    )
    parser.add_argument("--steps", type=int, default=50, help="steps of each simulator per round")
    parser.add_argument("--vehicles", type=int, nargs="+", default=[20, 50])
    parser.add_argument("--batch", type=int, nargs="+", default=[64, 1024])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    table = Table(
        title=f"env steps per CPU second, one thread ({CELL})",
        caption=f"goals: engine {ENGINE_GOAL} x, TorchRL {ENVIRONMENT_GOAL} x highway-env",
    )
    for column in ("cars", "batch", "highway-env", "engine", "ratio", "rounds", "TorchRL", "ratio", "rounds"):
        table.add_column(column, justify="right", no_wrap=True)
    for vehicles in arguments.vehicles:
        for row in compare(vehicles, tuple(arguments.batch), arguments.rounds, arguments.steps):
            table.add_row(*row)
    # Piped output has no width; the table needs more than the default of 80 columns.
    Console(width=max(Console().width, 100)).print(table)


if __name__ == "__main__":
    main()
