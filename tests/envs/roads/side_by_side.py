"""Drive highway-env and the engine side by side through whole episodes, and count all differences.

    python -m tests.envs.roads.side_by_side TASK[,TASK...] SEEDS [FIRST]

prints the counts as JSON. An intersection needs a process of its own: making one rewrites constants of highway-env's classes.
"""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

FIELDS = ("x", "y", "heading", "speed", "crashed")


def exact_environment() -> dict[str, str]:
    """Variables of a process whose numpy and BLAS round like scalar code: they have no AVX-512 kernels."""
    from numpy._core._multiarray_umath import __cpu_dispatch__ as kernels  # type: ignore[attr-defined]

    wide = [name for name in kernels if "AVX512" in name or name == "X86_V4"]
    return os.environ | {"NPY_DISABLE_CPU_FEATURES": " ".join(wide), "OPENBLAS_CORETYPE": "Haswell"}


def action(space: Any, generator: np.random.Generator, seed: int, step: int) -> Any:
    """Five kinds of drivers by seed: random, IDLE, random every third decision, mostly fast, and random again.

    Continuous actions are random and of five sizes.
    """
    if not hasattr(space, "n"):
        size = np.float32((1, 0.3, 0.05, 0.02, 0.1)[seed % 5])
        return generator.uniform(-1, 1, space.shape).astype(np.float32) * size
    count = int(space.n)
    chosen, kind = int(generator.integers(count)), seed % 5
    if kind == 1 or (kind == 2 and step % 3):
        return 1
    if kind == 3 and generator.random() < 0.7:
        return 3 if count == 5 else 2
    return chosen


def compare(task: str, seeds: range) -> Counter[str]:
    """Episodes, steps and events, and under "differs: ..." how many steps were not equal, to the last bit."""
    import gymnasium
    import highway_env  # noqa: F401

    from cavbench.envs.roads.engine import RoadsEngine
    from cavbench.envs.roads.originals import original

    simulator, engine = gymnasium.make(task, disable_env_checker=True), RoadsEngine(original(task))
    counts: Counter[str] = Counter()
    for seed in seeds:
        found = _compare_one(simulator, engine, seed)
        counts.update(found)
        counts["equal episodes"] += not any(name.startswith("differs") for name in found)
        counts["episodes"] += 1
    return counts


def _compare_one(simulator: Any, engine: Any, seed: int) -> Counter[str]:
    counts: Counter[str] = Counter()
    generator = np.random.default_rng(seed)
    observation, _ = simulator.reset(seed=seed)
    engine.reset(np.array([0]), np.array([seed]))
    counts.update(_differing(simulator, engine, observation))
    ended, step = False, 0
    while not ended:
        chosen = action(simulator.action_space, generator, seed, step)
        observation, reward, terminated, truncated, info = simulator.step(chosen)
        engine.step(np.array([chosen]))
        counts.update(_differing(simulator, engine, observation))
        counts.update(_differing_end(engine, reward, terminated, truncated, info))
        ended, step = terminated or truncated, step + 1
    counts["steps"] += step
    counts["crashed cars"] += sum(car.crashed for car in simulator.unwrapped.road.vehicles)
    counts["crashed egos"] += int(simulator.unwrapped.vehicle.crashed)
    return counts


def _differing(simulator: Any, engine: Any, observation: np.ndarray) -> Iterator[str]:
    """Names of the parts of the state and of the observation that differ."""
    cars = simulator.unwrapped.road.vehicles
    ours = engine.bodies[0][: engine.episodes["cars"][0]]
    if len(cars) != len(ours):
        yield "differs: number of cars"
        return
    theirs = [(*car.position, car.heading, car.speed, car.crashed) for car in cars]
    for name, values in zip(FIELDS, zip(*theirs, strict=True), strict=True):
        if (ours[name] != np.array(values)).any():
            yield f"differs: {name}"
    targets = [car for car in cars if hasattr(car, "target_speed")]
    if len(targets) == len(cars) and (ours["target_speed"] != [car.target_speed for car in cars]).any():
        yield "differs: target speed"
    if (engine.observation[0].ravel() != observation.ravel()).any():
        yield "differs: observation"


def _differing_end(
    engine: Any, reward: float, terminated: bool, truncated: bool, info: dict[str, Any]
) -> Iterator[str]:
    """Names of what a step returns besides the observation that differs."""
    episode = engine.episodes[0]
    if episode["reward"] != reward:
        yield "differs: reward"
    if (episode["terminated"], episode["truncated"]) != (terminated, truncated):
        yield "differs: end"
    ego = engine.bodies[0][episode["ego"]]
    if (ego["speed"], ego["crashed"]) != (info["speed"], info["crashed"]):
        yield "differs: info"
    parts = [float(value) for value in info["rewards"].values()]
    if list(engine.parts[0][: len(parts)]) != parts:
        yield "differs: parts of the reward"


if __name__ == "__main__":
    FIRST = int(sys.argv[3]) if len(sys.argv) > 3 else 0
    for name in sys.argv[1].split(","):
        found = compare(name, range(FIRST, FIRST + int(sys.argv[2])))
        sys.stdout.write(json.dumps({"task": name} | dict(sorted(found.items()))) + "\n")
