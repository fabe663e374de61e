"""Drive highway-env and the engine side by side and count all differences, for the parity tests."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cavbench.envs.highway.config import HighwayConfig
from cavbench.envs.highway.engine import Flag, HighwayEngine, Number
from cavbench.envs.highway.reference import SensedHighwayEnv
from cavbench.scenarios import Cell

Chooser = Callable[[np.random.Generator, int], Any]
STATE = ("x", "y", "heading", "speed", "lane", "crashed", "target_lane", "target_speed", "timer", "delta")


def discrete(*actions: int, every: int = 1) -> Chooser:
    """One of `actions` at random every so many steps, IDLE in between."""
    return lambda generator, step: int(generator.choice(actions)) if step % every == 0 else 1


def continuous(steering: float, every: int = 1) -> Chooser:
    """Random acceleration, and steering within +-`steering`, every so many steps; zero in between."""

    def choose(generator: np.random.Generator, step: int) -> np.ndarray:
        action = generator.uniform(-1, 1, 2) * [1.0, steering]
        return (action if step % every == 0 else np.zeros(2)).astype(np.float32)

    return choose


@dataclass(frozen=True, kw_only=True)
class Case:
    """One comparison: a cell, its scenario seeds, and how the ego acts; `after_end` steps follow its end."""

    cell: Cell
    seeds: tuple[int, ...]
    choose: Chooser
    steps: int
    after_end: int = 20
    options: dict[str, Any] = field(default_factory=dict)


def compare(case: Case, tolerance: float = 0.0) -> Counter[str]:
    """Drive a case in both simulators.

    Args:
        case: what to drive.
        tolerance: absolute difference of floating-point numbers that still counts as equal.

    Returns:
        How many steps, lane changes, aborted ones, crashed vehicles and off-road ends there were; and, under
        "differs: ...", how many times that was not equal.
    """
    counts: Counter[str] = Counter()
    for seed in case.seeds:
        counts.update(_compare_one(case, seed, tolerance))
    return counts


def differences(counts: Counter[str]) -> dict[str, int]:
    """The counts of differences."""
    return {name: count for name, count in counts.items() if name.startswith("differs")}


def _compare_one(case: Case, seed: int, tolerance: float) -> Counter[str]:
    config = HighwayConfig(cells=(case.cell,), max_steps=10**9, **case.options)
    simulator, engine = SensedHighwayEnv(config, case.cell), HighwayEngine(config)
    counts: Counter[str] = Counter()
    generator = np.random.default_rng(seed)
    observation, reward, ended = simulator.start(seed), 0.0, False
    engine.reset(np.array([0]), np.array([seed]))
    counts.update(_differing(simulator, engine, observation, reward, ended, tolerance))
    left = case.steps
    while left > 0:
        before = engine.vehicles[0].copy()
        action = case.choose(generator, case.steps - left)
        observation, reward, ended = simulator.decide(action)
        # Neither is stopped by a crash: what follows it must be equal too.
        engine.episodes["terminated"] = False
        engine.step(np.array([action]))
        counts.update(_differing(simulator, engine, observation, reward, ended, tolerance))
        counts.update(_events(before, engine.vehicles[0]))
        left = min(left - 1, case.after_end) if ended else left - 1
    counts["crashed vehicles"] += int(engine.vehicles["crashed"].sum())
    counts["off-road ends"] += int(ended and not simulator.vehicle.crashed)
    return counts


def _events(before: np.ndarray, after: np.ndarray) -> Counter[str]:
    changed = before["target_lane"] != after["target_lane"]
    stayed = before["lane"] == after["lane"]
    aborted = changed & stayed & (after["target_lane"] == after["lane"])
    return Counter({"steps": 1, "lane changes": int((changed & ~aborted).sum()), "aborts": int(aborted.sum())})


def state_of(simulator: SensedHighwayEnv) -> dict[str, np.ndarray]:
    """The state of highway-env's vehicles under the engine's names; attributes that only some vehicles have cover the last."""
    vehicles = simulator.road.vehicles
    drivers = [v for v in vehicles if hasattr(v, "target_lane_index")]
    idm = [v for v in vehicles if hasattr(v, "timer")]
    columns: dict[str, list[Any]] = {
        "x": [v.position[0] for v in vehicles],
        "y": [v.position[1] for v in vehicles],
        "heading": [v.heading for v in vehicles],
        "speed": [v.speed for v in vehicles],
        "lane": [v.lane_index[2] for v in vehicles],
        "crashed": [v.crashed for v in vehicles],
        "target_lane": [v.target_lane_index[2] for v in drivers],
        "target_speed": [v.target_speed for v in drivers],
        "timer": [v.timer for v in idm],
        "delta": [v.DELTA for v in idm],
    }
    return {name: np.array(columns[name]) for name in STATE}


def _differing(
    simulator: SensedHighwayEnv,
    engine: HighwayEngine,
    observation: np.ndarray,
    reward: float,
    ended: bool,
    tolerance: float,
) -> Iterator[str]:
    """Names of all values that currently differ."""
    for name, values in state_of(simulator).items():
        ours = engine.vehicles[name][0][-len(values) :]
        close = np.abs(ours - values).max() <= tolerance if values.dtype.kind == "f" else (ours == values).all()
        if not close:
            yield f"differs: {name}"
    # A float32 observation may round the other way when its float64 differs within the tolerance.
    if np.abs(engine.observation[0] - observation).max() > (1e-6 if tolerance else 0):
        yield "differs: observation"
    episode = engine.episodes[0]
    if abs(episode["reward"] - reward) > tolerance:
        yield "differs: reward"
    if episode["terminated"] != ended:
        yield "differs: termination"
    if engine.flags[Flag.OFFROAD, 0] == simulator.vehicle.on_road:
        yield "differs: off-road"
    if simulator.decisions and abs(episode["progress"] - simulator.progress()) > tolerance:
        yield "differs: progress"
    ttc = np.float32(simulator.time_to_collision())
    if not np.isclose(engine.numbers[Number.TTC, 0], ttc, rtol=1e-6 if tolerance else 0, atol=0):
        yield "differs: time to collision"
