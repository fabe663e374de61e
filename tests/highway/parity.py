"""Drive highway-env and the engine side by side and count every difference. Run as a program by the parity tests.

    python -m tests.highway.parity [case ...]

Exits with 1 if any bit differs. numpy's AVX-512 kernels round differently from scalar code, so the tests run this in a
process of its own that has them switched off (see `test_parity.py`).
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.scenario import Cell
from envs.highway.config import THESIS_TARGET_SPEEDS, HighwayConfig
from envs.highway.engine import Flag, HighwayEngine, Number
from envs.highway.reference import SensedHighwayEnv

Chooser = Callable[[np.random.Generator, int], Any]


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
    """One comparison: a world, its scenario seeds, and how the ego acts."""

    cell: Cell
    seeds: tuple[int, ...]
    choose: Chooser
    steps: int = 150
    after_end: int = 20
    options: dict[str, Any] = field(default_factory=dict)


def clear(lanes: int, density: float) -> Cell:
    return Cell(lanes=lanes, density=density)


ANY = discrete(0, 1, 2, 3, 4)
CASES: dict[str, Case] = {
    "3-lanes": Case(cell=clear(3, 1), seeds=(1_000_000, 1_000_001), choose=discrete(0, 1, 2, 3, 4, every=10)),
    "4-lanes-dense": Case(cell=clear(4, 2), seeds=(3, 4), choose=ANY),
    "5-lanes": Case(cell=clear(5, 1), seeds=(5,), choose=discrete(0, 2, 4, every=5)),
    "5-lanes-dense-50": Case(cell=clear(5, 2), seeds=(6,), choose=discrete(1), options={"vehicles": 50}, steps=100),
    "full-speed": Case(cell=clear(3, 2), seeds=(7, 8, 9), choose=discrete(3), after_end=40),
    "thesis-speeds": Case(
        cell=clear(3, 1.5), seeds=(10, 11), choose=ANY, options={"target_speeds": THESIS_TARGET_SPEEDS}, steps=120
    ),
    "continuous": Case(
        cell=clear(3, 1), seeds=(12, 13), choose=continuous(0.02), options={"action_type": "continuous"}
    ),
    "continuous-offroad": Case(
        cell=clear(4, 2),
        seeds=(14, 15),
        choose=continuous(1.0, every=7),
        options={"action_type": "continuous"},
        steps=80,
    ),
    "idm": Case(cell=clear(4, 1), seeds=(16, 17), choose=discrete(1), options={"driver": "idm"}),
    "idm-dense": Case(cell=clear(3, 2), seeds=(18,), choose=discrete(1), options={"driver": "idm"}),
    "1-hz": Case(cell=clear(3, 1), seeds=(19, 20), choose=ANY, options={"policy_frequency": 1}, steps=30),
    "5-hz-physics": Case(
        cell=clear(3, 1),
        seeds=(21,),
        choose=ANY,
        options={"policy_frequency": 5, "simulation_frequency": 5, "normalize_reward": False, "ego_spacing": 1.5},
    ),
    "fog": Case(cell=Cell(lanes=3, density=2, weather="fog"), seeds=(22,), choose=discrete(1, 4), steps=60),
    "rain": Case(cell=Cell(lanes=4, density=1, weather="rain"), seeds=(23,), choose=ANY, steps=60),
}


def state_of(simulator: SensedHighwayEnv) -> dict[str, np.ndarray]:
    """The state of highway-env's vehicles, in the engine's names."""
    vehicles = simulator.road.vehicles
    state = {
        "x": [v.position[0] for v in vehicles],
        "y": [v.position[1] for v in vehicles],
        "heading": [v.heading for v in vehicles],
        "speed": [v.speed for v in vehicles],
        "lane": [v.lane_index[2] for v in vehicles],
        "crashed": [v.crashed for v in vehicles],
    }
    drivers = [v for v in vehicles if hasattr(v, "target_lane_index")]
    state["target_lane"] = [v.target_lane_index[2] for v in drivers]
    state["target_speed"] = [v.target_speed for v in drivers]
    state["timer"] = [v.timer for v in vehicles if hasattr(v, "timer")]
    state["delta"] = [v.DELTA for v in vehicles if hasattr(v, "timer")]
    return {name: np.array(values) for name, values in state.items()}


def compare(case: Case, seed: int, *, tolerance: float = 0.0) -> Counter[str]:
    """Drive one scenario in both; what was counted, the differences under the names of what differed.

    Args:
        case: what to drive.
        seed: the scenario.
        tolerance: absolute difference of state, observation and reward that still counts as equal.
    """
    config = HighwayConfig(cells=(case.cell,), max_steps=10**9, **case.options)
    simulator, engine = SensedHighwayEnv(config, case.cell), HighwayEngine(config)
    counts: Counter[str] = Counter()
    generator = np.random.default_rng(seed)
    expected, result = simulator.start(seed), (0.0, False)
    engine.reset(np.array([0]), np.array([seed]))
    ended = 0
    targets = state_of(simulator)["target_lane"]
    for step in range(case.steps + 1):
        counts.update(_differences(simulator, engine, expected, result, tolerance))
        if result[1]:
            ended += 1
        if ended > case.after_end:
            break
        action = case.choose(generator, step)
        expected, *result = simulator.decide(action)
        if engine.episodes["terminated"][0]:
            engine.episodes["terminated"] = False  # drive on, to compare what follows a crash
        engine.step(np.array([action]))
        now = state_of(simulator)
        counts["steps"] += 1
        counts["lane changes"] += int((now["target_lane"] != targets).sum())
        counts["aborts"] += int(
            ((now["target_lane"] != targets) & (now["target_lane"] == now["lane"][-len(targets) :])).sum()
        )
        targets = now["target_lane"]
    counts["crashed vehicles"] += int(state_of(simulator)["crashed"].sum())
    counts["off-road ends"] += int(result[1] and not simulator.vehicle.crashed)
    return counts


def _differences(
    simulator: SensedHighwayEnv, engine: HighwayEngine, expected: np.ndarray, result: Any, tolerance: float
) -> Iterator[str]:
    """Names of everything that is not equal now."""
    for name, values in state_of(simulator).items():
        ours = engine.vehicles[name][0][-len(values) :]
        if not np.allclose(ours, values, rtol=0, atol=tolerance if values.dtype.kind == "f" else 0):
            yield f"differs: {name}"
    if not np.allclose(engine.observation[0], expected, rtol=0, atol=tolerance):
        yield "differs: observation"
    reward, terminated = result
    if abs(engine.episodes["reward"][0] - reward) > tolerance:
        yield "differs: reward"
    if engine.episodes["terminated"][0] != terminated:
        yield "differs: termination"
    if not np.isclose(engine.numbers[Number.TTC, 0], np.float32(simulator.time_to_collision()), rtol=1e-6):
        yield "differs: ttc"
    if engine.flags[Flag.OFFROAD, 0] == simulator.vehicle.on_road:
        yield "differs: off-road"
    if simulator.decisions and abs(engine.episodes["progress"][0] - simulator.progress()) > 1e-12:
        yield "differs: progress"


def main(names: list[str]) -> int:
    """Compare the named cases, or all; one line each. 1 if anything differs."""
    total: Counter[str] = Counter()
    for name in names or CASES:
        counts: Counter[str] = Counter()
        for seed in CASES[name].seeds:
            counts.update(compare(CASES[name], seed))
        sys.stdout.write(f"{name}: {dict(counts)}\n")
        total.update(counts)
    sys.stdout.write(f"total: {dict(total)}\n")
    return int(any(key.startswith("differs") for key in total))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
