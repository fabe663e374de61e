"""Measures how much faster than highway-env the engine of road networks is, per CPU second of one thread:

    python benchmarks/roads_speed.py [TASK ...] [--seconds 5] [--rounds 5] [--batch 64] [--envpool PYTHON]

Whole episodes with random actions, resets included; of a racetrack's steering a twentieth. Compilation is not counted.
The two take turns, so that other load on the machine affects both; a ratio is the median of the rounds, with the range of them.
With `--envpool` EnvPool is measured too, by a Python that has it (`envpool_speed.py`). Give the tasks of an intersection a run of
their own: making one changes the traffic of all later tasks of the process.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium
import highway_env  # noqa: F401
import numpy as np
from rich.console import Console

from cavbench.envs.highway.engine import Flag
from cavbench.envs.roads.engine import RoadsEngine
from cavbench.envs.roads.originals import ORIGINALS, original

STEERING = 0.05
GOAL, PEER_GOAL = 1000, 3
SEEDS = 100_000
"""Between the first scenarios of two rounds."""


def reference_rate(task: str, seconds: float, seed: int) -> float:
    """highway-env's steps per CPU second, from the scenario `seed` on."""
    env = gymnasium.make(task, disable_env_checker=True)
    generator, steps, start = np.random.default_rng(seed), 0, time.process_time()
    while time.process_time() - start < seconds:
        env.reset(seed=seed)
        seed, ended = seed + 1, False
        while not ended:
            _, _, terminated, truncated, _ = env.step(drawn(env.action_space, generator))
            ended, steps = terminated or truncated, steps + 1
    return steps / (time.process_time() - start)


def drawn(space: Any, generator: np.random.Generator) -> Any:
    """A random action."""
    if hasattr(space, "n"):
        return int(generator.integers(space.n))
    return (generator.uniform(-1, 1, space.shape) * STEERING).astype(np.float32)


def engine_rate(task: str, seconds: float, batch: int, seed: int) -> float:
    """The engine's steps per CPU second, all episodes together, from the scenario `seed` on."""
    config = original(task, batch)
    engine, generator = RoadsEngine(config), np.random.default_rng(seed)
    if config.action_type == "discrete":
        actions = generator.integers(0, len(config.actions), (512, batch))
    else:
        actions = (generator.uniform(-1, 1, (512, batch, 1)) * STEERING).astype(np.float32)
    engine.reset(np.arange(batch), np.arange(seed, seed + batch))
    engine.step(actions[0])
    steps, turn, seed, start = 0, 0, seed + batch, time.process_time()
    while time.process_time() - start < seconds:
        steps += int((~engine.flags[Flag.DONE]).sum())
        engine.step(actions[turn % len(actions)])
        turn += 1
        done = np.flatnonzero(engine.flags[Flag.DONE])
        if len(done):
            engine.reset(done, np.arange(seed, seed + len(done)))
            seed += len(done)
    return steps / (time.process_time() - start)


def peer_rate(python: str, task: str, seconds: float, batch: int) -> float:
    """EnvPool's steps per CPU second; NaN for a task that it does not have."""
    command = [python, Path(__file__).with_name("envpool_speed.py"), task, str(seconds), str(batch)]
    found = subprocess.run(command, capture_output=True, text=True)
    return float("nan") if found.returncode else float(found.stdout.splitlines()[-1])


def main() -> None:
    """Measure the tasks that the command line names."""
    parser = argparse.ArgumentParser(description="Speed of the engine of road networks against highway-env.")
    parser.add_argument("tasks", nargs="*", default=list(ORIGINALS), metavar="TASK")
    parser.add_argument("--seconds", type=float, default=5.0, help="of highway-env, a task")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--envpool", metavar="PYTHON", help="a Python that has EnvPool")
    options = parser.parse_args()
    console = Console(width=130)
    for task in options.tasks:
        share, rounds = options.seconds / options.rounds, range(options.rounds)
        rates = np.array(
            [
                (reference_rate(task, share, SEEDS * turn), engine_rate(task, share / 2, options.batch, SEEDS * turn))
                for turn in rounds
            ]
        )
        (theirs, ours), ratios = np.median(rates, 0), rates[:, 1] / rates[:, 0]
        console.print(
            f"{task}: {theirs:.0f} and {ours:.0f} steps a CPU second, {np.median(ratios):.0f} x, "
            f"{ratios.min():.0f} to {ratios.max():.0f} x (goal {GOAL} x)"
        )
        if options.envpool:
            peer = peer_rate(options.envpool, task, options.seconds, options.batch)
            console.print(f"  EnvPool: {peer:.0f}, {ours / peer:.1f} x (goal {PEER_GOAL} x)")


if __name__ == "__main__":
    main()
