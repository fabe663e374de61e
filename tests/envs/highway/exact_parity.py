"""The engine is highway-env, bit for bit. Run by `test_parity.py` in a process whose numpy has no AVX-512 kernels.

pytest does not collect this file: with AVX-512, numpy rounds some functions differently from scalar code.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavbench.driving.surroundings import Surroundings
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.config import THESIS_TARGET_SPEEDS, HighwayConfig
from cavbench.envs.highway.constants import OF_TRAFFIC
from cavbench.envs.highway.engine import HighwayEngine
from cavbench.envs.highway.reference import SensedHighwayEnv
from tests.envs.highway.side_by_side import STATE, Case, Chooser, compare, continuous, differences, discrete, state_of

ANY = discrete(0, 1, 2, 3, 4)
SOMETIMES = discrete(0, 1, 2, 3, 4, every=10)
IDLE = discrete(1)


def case(
    lanes: int, density: float, choose: Chooser, *seeds: int, steps: int, weather: str = "clear", **options: Any
) -> Case:
    cell = AXES.cell(lanes=lanes, density=density, weather=weather)
    return Case(cell=cell, seeds=seeds, choose=choose, steps=steps, options=options)


THESIS: dict[str, Any] = {"target_speeds": THESIS_TARGET_SPEEDS}
TASK: dict[str, Any] = THESIS | {
    "simulation_frequency": 5,
    "policy_frequency": 1,
    "ego_spacing": 1.5,
    "observed_vehicles": 5,
    "lane_range": True,
    "others_collide": False,
    "offroad_terminal": False,
}
DRIVE: dict[str, Any] = {"action_type": "continuous"}
FAST = {
    "discrete": case(3, 1, SOMETIMES, 1_000_000, steps=110),
    "discrete, dense, crash": case(4, 2, ANY, 3, steps=110),
    "full speed into the traffic": case(3, 2, discrete(3), 7, steps=130),
    "thesis' target speeds": case(3, 1.5, ANY, 11, steps=70, **THESIS),
    "continuous, off the road": case(4, 2, continuous(1.0, every=7), 14, steps=70, **DRIVE),
    "idm driver": case(3, 1, IDLE, 18, steps=60, driver="idm"),
    "1 Hz decisions": case(3, 1, ANY, 19, steps=8, policy_frequency=1),
    "highway-fast-v0": case(4, 2, ANY, 24, steps=12, **TASK),
    "fog": case(3, 2, discrete(1, 4), 22, steps=25, weather="fog"),
    "rain": case(4, 1, ANY, 23, steps=25, weather="rain"),
}
SLOW = {
    "3 lanes": case(3, 1, SOMETIMES, 1_000_001, steps=250),
    "4 lanes": case(4, 1, SOMETIMES, 1_000_002, steps=200),
    "5 lanes": case(5, 1, discrete(0, 2, 4, every=5), 5, steps=200),
    "3 lanes, density 2": case(3, 2, ANY, 1, steps=150),
    "4 lanes, density 2": case(4, 2, ANY, 4, steps=150),
    "5 lanes, density 2, 50 vehicles": case(5, 2, IDLE, 6, steps=150, vehicles=50),
    "full speed": case(3, 2, discrete(3), 8, 9, steps=150),
    "thesis' target speeds": case(3, 1.5, ANY, 10, steps=150, **THESIS),
    "continuous": case(3, 1, continuous(0.02), 12, 13, steps=150, **DRIVE),
    "continuous, off the road": case(5, 2, continuous(1.0, every=7), 14, 15, steps=100, **DRIVE),
    "idm driver": case(4, 1, IDLE, 16, steps=200, driver="idm"),
    "idm driver, density 2": case(3, 2, IDLE, 18, steps=200, driver="idm"),
    "1 Hz decisions": case(3, 1, ANY, 19, steps=30, policy_frequency=1),
    "5 Hz physics": case(3, 1, ANY, 21, steps=100, policy_frequency=5, simulation_frequency=5, ego_spacing=1.5),
    "plain reward": case(
        3, 1, ANY, 24, steps=100, normalize_reward=False, offroad_terminal=False, collision_reward=-5.0
    ),
}


@pytest.mark.parametrize("politeness", [0.4, 1.0])
def test_traffic_with_other_manners_is_that_of_highway_env(politeness: float, monkeypatch: pytest.MonkeyPatch) -> None:
    # The reference drives with these constants.
    for name, value in {
        "POLITENESS": politeness,
        "TIME_WANTED": 0.8,
        "LANE_CHANGE_MIN_ACC_GAIN": 0.1,
        "LANE_CHANGE_MAX_BRAKING_IMPOSED": 4.0,
        "COMFORT_ACC_MIN": -3.0,
    }.items():
        monkeypatch.setitem(OF_TRAFFIC, name, value)
    manners = Surroundings(politeness=politeness, time_gap=0.8, lane_gain=0.1, imposed_braking=4.0, braking=3.0)
    counts = compare(case(4, 2, SOMETIMES, 31, steps=110, surroundings=manners))
    assert not differences(counts)
    assert counts["lane changes"] > 0


@pytest.mark.parametrize("name", FAST)
def test_short_drive_is_bit_equal(name: str) -> None:
    assert not differences(compare(FAST[name]))


def test_reset_is_bit_equal_for_many_seeds() -> None:
    config = HighwayConfig(cells=(AXES.cell(lanes=3, density=1.0), AXES.cell(lanes=5, density=2.0)))
    simulators, engine = [SensedHighwayEnv(config, cell) for cell in config.cells], HighwayEngine(config)
    for seed in [*range(15), 2**31, 2**40 + 1, 2**62]:
        engine.reset(np.arange(2), np.array([seed, seed]))
        for row, simulator in enumerate(simulators):
            assert (simulator.start(seed) == engine.observation[row]).all()
            state = state_of(simulator)
            assert all((state[name] == engine.vehicles[name][row][-len(state[name]) :]).all() for name in STATE)


@st.composite
def random_cases(draw: st.DrawFn) -> Case:
    """Random cases over all valid configurations, for a few steps."""
    cell = AXES.cell(
        lanes=draw(st.integers(2, 8)),
        density=draw(st.floats(0.3, 4.0)),
        weather=draw(st.sampled_from(("clear", "clear", "rain", "fog"))),
    )
    options: dict[str, Any] = {
        "vehicles": draw(st.integers(1, 15)),
        "ego_spacing": draw(st.floats(0.5, 3.0)),
        "observed_vehicles": draw(st.integers(2, 12)),
        "driver": draw(st.sampled_from(("agent", "agent", "idm"))),
        "action_type": draw(st.sampled_from(("discrete", "continuous"))),
        "offroad_terminal": draw(st.booleans()),
        "normalize_reward": draw(st.booleans()),
        "lane_range": draw(st.booleans()),
        "others_collide": draw(st.booleans()),
        "start_lane": draw(st.sampled_from((None, None, 0, cell.lanes - 1))),
        "target_speeds": draw(
            st.sampled_from(((10.0, 15.0, 20.0, 25.0, 30.0), THESIS_TARGET_SPEEDS, (0.0, 20.0, 40.0)))
        ),
    }
    simulation = draw(st.sampled_from((5, 10, 15)))
    options |= {"simulation_frequency": simulation, "policy_frequency": simulation // draw(st.sampled_from((1, 5)))}
    choose = ANY if options["action_type"] == "discrete" else continuous(draw(st.sampled_from((0.02, 1.0))))
    return Case(cell=cell, seeds=(draw(st.integers(0, 10**6)),), choose=choose, steps=12, options=options)


@settings(max_examples=12, deadline=None, derandomize=True)
@given(random_cases())
def test_any_world_is_bit_equal_for_a_few_steps(world: Case) -> None:
    assert not differences(compare(world))


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(random_cases())
def test_any_of_many_worlds_is_bit_equal_for_a_few_steps(world: Case) -> None:
    assert not differences(compare(world))


@pytest.mark.slow
def test_two_thousand_steps_with_every_event_are_bit_equal() -> None:
    total = sum((compare(drive) for drive in SLOW.values()), start=compare(FAST["rain"]))
    sys.stdout.write(f"{dict(total)}\n")
    assert not differences(total)
    assert total["steps"] > 2000
    # A comparison that never met a crash or an aborted lane change would prove little.
    assert total["crashed vehicles"] > 5
    assert total["off-road ends"] > 1
    assert total["aborts"] > 10
    assert total["lane changes"] > 100
