"""What SUMO 1.28 does and few would guess, and that no score depends on it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavbench.driving import Control
from cavbench.envs.highway.config import ACTIONS
from cavbench.envs.highway.engine import Flag, Number
from cavbench.envs.sumo import motorway, network
from cavbench.envs.sumo.axes import SUMO
from cavbench.envs.sumo.cars import PERIOD_MS, Model, start
from cavbench.envs.sumo.engine import SumoEngine
from cavbench.envs.sumo.motorway import ON_MOTORWAY, START
from cavbench.envs.sumo.processes import Processes
from cavbench.envs.sumo.roads import Road
from cavbench.envs.sumo.worker import arguments
from cavbench.envs.sumo.world import SumoWorld

pytest.importorskip("libsumo", reason="needs SUMO: pip install 'cavbench[sumo]'")

WORLD = SumoWorld()
CELL = SUMO.cell(lanes=3, density=1.0)
SEED = 1_000_000
STEP_S = PERIOD_MS / 1000
IDLE = ACTIONS.index("IDLE")
LIBSUMO = """
import json, sys
import libsumo
program, *words = json.loads(sys.argv[1])
options = dict(zip(words[::2], words[1::2]))
def begin(changes=()):
    options.update(changes)
    libsumo.start([program, *(word for option in options.items() for word in option)])
    libsumo.route.add("way", ["before_0", "merge_0", "after_0"])
def put(name, lane, front, kind="KRAUSS", speed=20.0):
    libsumo.vehicle.add(name, "way", typeID=kind)
    libsumo.vehicle.moveTo(name, f"before_0_{lane}", front)
    libsumo.vehicle.setPreviousSpeed(name, speed, 0.0)
"""
"""The beginning of programs that show what SUMO does by itself."""


def shown(program: str) -> Any:
    """What a program with libsumo on a motorway prints last, as JSON."""
    command = arguments(str(network.network_file("motorway", [Road(3)])), str(network.types_file()))
    told = subprocess.run(
        [sys.executable, "-c", LIBSUMO + program, json.dumps(command)], capture_output=True, text=True, check=False
    )
    assert told.returncode == 0, told.stderr
    return json.loads(told.stdout.splitlines()[-1])


@contextmanager
def engine(
    batch: int = 1, driver: str = "agent", action_type: str = "discrete", processes: int = 1
) -> Iterator[SumoEngine]:
    """An engine on motorways of three lanes."""
    control = Control(driver=driver, action_type=action_type)  # type: ignore[arg-type]
    made = SumoEngine(WORLD.configuration((CELL,) * batch, control), WORLD.scene(), processes)
    with closing(made.processes):
        yield made


def beside(made: SumoEngine, other: int, x: float, y: float) -> None:
    """Put the ego beside another car, at so many metres from its centre, as fast as it is."""
    made.vehicles[0, 0]["x"] = made.vehicles[0, other]["x"] + x
    made.vehicles[0, 0]["y"] = made.vehicles[0, other]["y"] + y
    for name in ("speed", "target_speed"):
        made.vehicles[0, 0][name] = made.vehicles[0, other]["speed"]


def test_a_place_is_the_front_bumper() -> None:
    assert shown("begin(); put('car', 1, 100.0); print(libsumo.vehicle.getPosition('car')[0])") == 100.0
    with engine() as made:
        made.reset(np.arange(1), np.array([SEED]))
        assert made.vehicles[0, 0]["x"] == START - 2.5


def test_an_angle_is_clockwise_from_north_and_y_grows_to_the_left() -> None:
    with engine(action_type="continuous") as made:
        made.reset(np.arange(1), np.array([SEED]))
        for _ in range(10):
            before = made.vehicles[0, 0].copy()
            made.step(np.array([[0.0, 0.02]]))
        ego, (x, y, speed, angle) = made.vehicles[0, 0], made.processes.state()[0, 0]
        # To the right, which is down on SUMO's map.
        assert ego["y"] > before["y"]
        assert angle == pytest.approx(90 + np.degrees(ego["heading"]), abs=1e-9)
        assert angle > 90.5
        assert x == pytest.approx(ego["x"] + 2.5 * ego["cos_heading"], abs=1e-9)
        assert y == pytest.approx(-2 - ego["y"] - 2.5 * ego["sin_heading"], abs=1e-9)
        # What the traffic sees of its speed.
        assert speed == pytest.approx(ego["speed"], rel=0.02)


def test_times_are_whole_milliseconds() -> None:
    program = """
begin({"--step-length": str(1 / 15)})
for _ in range(450): libsumo.simulationStep()
print(libsumo.simulation.getTime())"""
    assert shown(program) == 30.15
    facts = SumoWorld().facts
    assert facts.max_steps / facts.decision_hz == pytest.approx(30.15)
    with engine() as made:
        made.reset(np.arange(1), np.array([SEED]))
        cars, expected, begin = made.vehicles[0], np.zeros(21), made.vehicles[0]["x"].copy()
        for _ in range(100):
            speeds = cars["speed"].copy()
            made.step(np.array([IDLE]))
            # The ballistic step: the mean of the speeds before and after it.
            expected += (speeds + cars["speed"]) / 2 * STEP_S
        # Those on the ramp come nearer. 1/15 s would be 0.5 % less.
        through = begin > START
        assert through.sum() > 10
        assert (cars["x"] - begin)[through].sum() == pytest.approx(expected[through].sum(), rel=1e-3)
        assert cars["x"][0] - begin[0] == pytest.approx(100 * 25 * STEP_S)


def test_a_car_that_is_only_added_is_nowhere_and_those_of_an_episode_are_there_at_their_speed() -> None:
    added = "begin(); libsumo.vehicle.add('car', 'way', typeID='KRAUSS'); print(libsumo.vehicle.getPosition('car')[0])"
    assert shown(added) == -1073741824.0
    cars = start(0, SEED, CELL, 20, Model.EGO)
    with engine() as made:
        made.reset(np.arange(1), np.array([SEED]))
        there = made.vehicles[0]
        assert len(cars) == 21
        assert there["speed"] == pytest.approx(cars["speed"])
        through = cars["route"] == ON_MOTORWAY
        assert there["y"][through] == pytest.approx(4.0 * cars["lane"][through])
        made.step(np.array([IDLE]))
        assert there["speed"] == pytest.approx(cars["speed"], abs=0.7)


def test_a_car_without_an_acceleration_jumps_in_its_first_step() -> None:
    program = """
begin(); put("car", 1, 100.0); put("told", 1, 200.0)
libsumo.vehicle.setPreviousSpeed("car", 20.0)
libsumo.simulationStep()
print([libsumo.vehicle.getSpeed("car"), libsumo.vehicle.getSpeed("told")])"""
    jumped, told = shown(program)
    assert jumped > 30
    assert told == pytest.approx(20.0, abs=0.3)


def test_a_side_swipe_that_sumo_does_not_report_is_a_crash() -> None:
    program = """
begin({"--collision.action": "warn"}); put("other", 1, 100.0, "EGO"); put("ego", 2, 100.0, "EGO")
reported = 0
for step in range(1, 6):
    for name, y in (("other", -4.8), ("ego", -3.8)):
        libsumo.vehicle.moveToXY(name, "", -1, 100 + step * 1.34, y, 90.0, 1)
    libsumo.simulationStep()
    reported += len(libsumo.simulation.getCollisions())
print([reported, libsumo.vehicle.getPosition("ego")[1] - libsumo.vehicle.getPosition("other")[1]])"""
    reported, apart = shown(program)
    assert (reported, apart) == (0, pytest.approx(1.0))
    with engine() as made:
        for across, crashed in ((1.9, True), (2.1, False)):
            made.reset(np.arange(1), np.array([SEED]))
            beside(made, 1, 1.0, -across if made.vehicles[0, 1]["y"] > 0 else across)
            made.vehicles[0, 0]["target_lane"] = round(float(made.vehicles[0, 0]["y"]) / 4)
            made.step(np.array([IDLE]))
            assert made.flags[Flag.CRASHED, 0] == crashed


def test_a_small_gap_that_sumo_calls_a_collision_is_none() -> None:
    program = """
begin({"--collision.action": "warn", "--collision.mingap-factor": "1"}); put("other", 1, 100.0); put("ego", 1, 93.0, "EGO")
for step in range(3):
    libsumo.vehicle.moveToXY("ego", "", -1, 95.5 + 1.34 * step, -6.0, 90.0, 1)
    libsumo.simulationStep()
gap = libsumo.vehicle.getPosition("other")[0] - 5 - libsumo.vehicle.getPosition("ego")[0]
print([len(libsumo.simulation.getCollisions()), gap])"""
    reported, gap = shown(program)
    assert reported == 1
    assert gap > 0.5
    with engine() as made:
        made.reset(np.arange(1), np.array([SEED]))
        beside(made, 1, -5.8, 0.0)
        made.vehicles[0, 0]["target_lane"] = made.vehicles[0, 1]["lane"]
        made.step(np.array([IDLE]))
        assert not made.flags[Flag.CRASHED, 0]
        beside(made, 1, -4.9, 0.0)
        made.step(np.array([IDLE]))
        assert made.flags[Flag.CRASHED, 0]


def driven(made: SumoEngine, row: int, seed: int, steps: int = 60) -> np.ndarray:
    """The places of all cars of an episode, step by step [T, N, 3]."""
    made.reset(np.array([row]), np.array([seed]))
    found = []
    for _ in range(steps):
        made.step(np.full(made.config.batch, IDLE))
        cars = made.vehicles[row]
        found.append(np.stack([cars["x"], cars["y"], cars["speed"]], -1))
    return np.array(found)


def test_an_episode_depends_neither_on_its_place_nor_on_what_was_driven_before() -> None:
    with engine(3, "idm") as made, engine(1, "idm") as alone:
        made.reset(np.array([0, 1]), np.array([SEED + 1, SEED + 2]))
        first = driven(made, 2, SEED)
        again = driven(made, 0, SEED)
        assert np.array_equal(first, again)
        # Two simulations at once: libsumo would close the first of them in one process.
        assert np.array_equal(first, driven(alone, 0, SEED))
        assert not np.array_equal(first, driven(made, 0, SEED + 3))


def test_results_do_not_depend_on_the_number_of_processes() -> None:
    found = []
    for processes in (1, 3):
        with engine(4, processes=processes) as made:
            made.reset(np.arange(4), np.arange(SEED, SEED + 4))
            for action in (0, 1, 2, 3, 4) * 8:
                made.step(np.full(4, action))
            found.append((made.observation.copy(), made.numbers.copy()))
    assert np.array_equal(found[0][0], found[1][0])
    assert np.array_equal(found[0][1], found[1][1])


def test_cars_behind_brake_for_the_ego() -> None:
    with engine(action_type="continuous") as made:
        made.reset(np.arange(1), np.array([SEED]))
        beside(made, 1, 30.0, 0.0)
        speed = float(made.vehicles[0, 1]["speed"])
        for _ in range(25):
            made.step(np.array([[-1.0, 0.0]]))
        assert not made.flags[Flag.CRASHED, 0]
        assert made.vehicles[0, 1]["speed"] < speed - 3


def test_finished_episodes_do_not_change_and_cost_no_car() -> None:
    with engine(2) as made:
        made.reset(np.arange(2), np.arange(SEED, SEED + 2))
        beside(made, 1, 0.0, 0.5)
        made.step(np.array([IDLE, IDLE]))
        assert made.flags[Flag.DONE].tolist() == [True, False]
        seen, cars = made.observation[0].copy(), made.vehicles[0].copy()
        made.step(np.array([IDLE, IDLE]))
        assert np.array_equal(made.observation[0], seen)
        assert (made.vehicles[0] == cars).all()
        assert made.numbers[Number.REWARD, 0] == 0
        assert np.isnan(made.processes.state()[0]).all()
        assert not np.isnan(made.processes.state()[1]).any()
        with pytest.raises(ValueError, match="none can be paused"):
            made.step(np.array([IDLE, IDLE]), np.array([False, True]))


def test_a_damaged_network_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    kept = network.network_file("motorway", [Road(2)])
    assert kept.is_relative_to(tmp_path)
    assert network.network_file("motorway", [Road(2)]) == kept
    kept.write_bytes(kept.read_bytes()[:2000])
    damaged = Processes("motorway", [Road(2)], 2, 1)
    with closing(damaged), pytest.raises(network.UserError) as caught:
        damaged.state()
    assert str(caught.value).startswith("SUMO has ended: ")
    assert str(caught.value).endswith(f"delete {kept}")
    assert "\n" not in str(caught.value)


def test_what_netconvert_refuses_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    broken = {"--node-files": "<nodes>", "--edge-files": "<edges/>"}
    monkeypatch.setattr(motorway, "plain_network", lambda roads: broken)
    with pytest.raises(network.UserError, match="netconvert made no network: ") as caught:
        network.network_file("motorway", [Road(2)])
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.rglob("*.xml"))
