"""The world `sumo_crossing`: who goes first, crashes from the side, and independence of episodes."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest
import torch

from cavbench.driving import Control
from cavbench.envs.highway.config import ACTIONS
from cavbench.envs.highway.engine import Flag
from cavbench.envs.sumo.axes import CROSSING, SUMO_CROSSING_V1
from cavbench.envs.sumo.cars import PERIOD_MS, Model
from cavbench.envs.sumo.crossing import LENGTH, MIDDLE, ROUTES
from cavbench.envs.sumo.crossing_cars import FIRST, start
from cavbench.envs.sumo.crossing_world import SumoCrossingWorld
from cavbench.envs.sumo.engine import SumoEngine
from tests.checks.rules import broken

WORLD = SumoCrossingWorld()
SEED = SUMO_CROSSING_V1.first_seed
IDLE, FASTER, SLOWER = (ACTIONS.index(name) for name in ("IDLE", "FASTER", "SLOWER"))
needs_sumo = pytest.mark.skipif(
    importlib.util.find_spec("libsumo") is None, reason="needs SUMO: pip install 'cavbench[sumo]'"
)


@contextmanager
def engine(batch: int, driver: str = "agent", processes: int = 1, **values: Any) -> Iterator[SumoEngine]:
    """An engine at crossings, in the home cell but for `values`."""
    cells = (CROSSING.cell(**dict(WORLD.home) | values),) * batch
    made = SumoEngine(WORLD.configuration(cells, Control(driver=driver)), WORLD.scene(), processes)  # type: ignore[arg-type]
    with closing(made.processes):
        yield made


@pytest.mark.parametrize("lanes", [1, 3])
def test_a_nearly_empty_crossing_has_few_cars_or_none(lanes: int) -> None:
    for density, most in ((0.04, 8), (1e-6, 0)):
        cell = CROSSING.cell(lanes=lanes, density=density, rule="yield")
        for seed in range(SEED, SEED + 5):
            assert 0 <= len(start(0, seed, cell, 24, Model.EGO)) - 1 <= most


@needs_sumo
def test_it_keeps_the_rules_of_every_world() -> None:
    assert broken("world", "sumo_crossing") == {}


def test_the_cars_of_an_episode_follow_from_its_seed_and_nobody_starts_in_another() -> None:
    for cell in SUMO_CROSSING_V1.cells():
        for seed in range(SEED, SEED + 20):
            cars = start(0, seed, cell, 24, Model.EGO)
            assert cars.tobytes() == start(0, seed, cell, 24, Model.EGO).tobytes()
            assert len(cars) <= 25
            assert ROUTES[cars["route"][0]] == ("west", "east")
            sides = [ROUTES[route][0] for route in cars["route"]]
            for side, first in FIRST.items():
                for lane in range(cell.lanes):
                    here = (np.array(sides) == side) & (cars["lane"] == lane)
                    fronts = np.sort(cars["front"][here])
                    # No two bodies touch, and SUMO's gap between bumpers is there.
                    assert (np.diff(fronts) > 7.5).all()
                    assert (fronts <= -first).all()
            assert (cars["front"] > -LENGTH).all()
            # All others on the ego's road are ahead of it.
            ahead = np.array(sides) == "west"
            assert cars["front"][0] == cars["front"][ahead].min()


@needs_sumo
@pytest.mark.parametrize("rule", ["yield", "allway_stop"])
def test_a_driver_of_sumo_keeps_the_rules_and_a_blind_one_crashes(rule: str) -> None:
    crashes = {}
    for driver in ("idm", "agent"):
        with engine(16, driver, density=2.0, rule=rule) as made:
            made.reset(np.arange(16), np.arange(SEED, SEED + 16))
            while not made.flags[Flag.DONE].all():
                made.step(np.full(16, FASTER))
            crashes[driver] = int(made.flags[Flag.CRASHED].sum())
            assert not made.flags[Flag.OFFROAD].any()
    assert crashes["idm"] == 0
    assert crashes["agent"] >= 4


@needs_sumo
def test_who_goes_first_is_the_rule() -> None:
    """SUMO's driver passes sooner where its turn comes than where it must yield to all."""
    passed = {}
    for rule in ("yield", "allway_stop"):
        with engine(16, "idm", density=2.0, lanes=1, rule=rule) as made:
            made.reset(np.arange(16), np.arange(SEED, SEED + 16))
            for _ in range(WORLD.max_steps):
                made.step(np.full(16, IDLE))
            passed[rule] = int((made.vehicles["x"][:, 0] > MIDDLE + 10).sum())
    assert passed["allway_stop"] > passed["yield"]


@needs_sumo
def test_cars_turn_and_cross_where_the_ego_can_meet_them_and_are_seen_with_their_own_direction() -> None:
    with engine(8, lanes=1) as made:
        made.reset(np.arange(8), np.arange(SEED, SEED + 8))
        headings = []
        for _ in range(100):
            made.step(np.full(8, SLOWER))
            headings.append(made.vehicles["heading"][:, 1:].copy())
        turns = np.abs(np.array(headings))
        # Straight on, towards the ego, across, and somewhere in a turn.
        for low, high in ((0, 0.01), (3.1, 3.15), (1.56, 1.58), (0.5, 1.0)):
            assert ((turns > low) & (turns < high)).any(), (low, high)
        # A car across is seen to move across: as fast as it moves from one frame to the next.
        across = np.abs(np.sin(made.vehicles["heading"][0])) > 0.99
        number = int(np.flatnonzero(across & (np.abs(made.vehicles["y"][0]) < 80) & (made.vehicles["speed"][0] > 3))[0])
        before = made.vehicles[0, number].copy()
        made.step(np.full(8, SLOWER))
        after = made.vehicles[0, number]
        moved = (after["y"] - before["y"]) / (PERIOD_MS / 1000)
        assert moved == pytest.approx(before["speed"] * np.sin(before["heading"]), abs=0.5)
        rows = made.observation[0, 1:]
        shown = rows[rows[:, 0] > 0]
        place = shown[:, 1:3] * np.array([300, 100])
        ego = made.vehicles[0, 0]
        distance = np.abs(place - np.array([after["x"] - ego["x"], after["y"] - ego["y"]])).max(1)
        row = int(distance.argmin())
        # The sensor has noise in no weather but rain and fog.
        assert distance[row] < 0.01
        assert shown[row, 4] * 30 == pytest.approx(after["speed"] * np.sin(after["heading"]), abs=0.01)


@needs_sumo
def test_a_car_from_the_side_is_a_crash_at_the_overlap_of_bodies() -> None:
    with engine(1) as made:
        for apart, crashed in ((3.4, True), (3.7, False)):
            made.reset(np.arange(1), np.array([SEED]))
            across = np.abs(np.sin(made.vehicles["heading"][0])) > 0.99
            other = made.vehicles[0, int(np.flatnonzero(across)[0])]
            ego = made.vehicles[0, 0]
            # The bodies lie at a right angle: 2.5 m of one and 1 m of the other.
            ego["x"], ego["y"] = other["x"] - apart, other["y"]
            ego["speed"] = ego["target_speed"] = 0.0
            made.step(np.array([IDLE]))
            assert made.flags[Flag.CRASHED, 0] == crashed


@needs_sumo
def test_results_do_not_depend_on_the_place_in_the_batch_nor_on_processes() -> None:
    found = []
    for seeds, processes in (
        (range(SEED, SEED + 4), 1),
        (range(SEED, SEED + 4), 3),
        (range(SEED + 3, SEED - 1, -1), 2),
    ):
        with engine(4, processes=processes, rule="allway_stop") as made:
            made.reset(np.arange(4), np.array(seeds))
            for action in (IDLE, FASTER, SLOWER, FASTER) * 12:
                made.step(np.full(4, action))
            found.append(made.observation[np.argsort(seeds)].copy())
    assert np.array_equal(found[0], found[1])
    assert np.array_equal(found[0], found[2])


def test_a_cell_that_there_is_not_is_one_line() -> None:
    with pytest.raises(ValueError, match=r"^rule must be one of yield, allway_stop, got first$"):
        CROSSING.cell(**dict(WORLD.home) | {"rule": "first"})


@needs_sumo
def test_the_ego_sees_how_far_the_crossing_is() -> None:
    with engine(8) as made:
        made.reset(np.arange(8), np.arange(SEED, SEED + 8))
        for _ in range(WORLD.max_steps):
            made.step(np.full(8, IDLE))
            seen = made.observation[:, 0, 1] * 300
            assert seen == pytest.approx(made.vehicles["x"][:, 0], abs=0.01)
        # At 10 m/s it is far behind the crossing at the end, where it did not crash.
        assert seen.max() > MIDDLE + 100


@needs_sumo
def test_safe_progress_is_the_speed_alone() -> None:
    env = WORLD.make([WORLD.home] * 2)
    td = env.reset()
    for _ in range(5):
        td = env.step(td.set("action", torch.tensor([IDLE, FASTER])))["next"]
        assert td["info", "progress"].squeeze(-1) == pytest.approx(td["info", "speed"].squeeze(-1) / 15, abs=1e-5)
    env.close()
