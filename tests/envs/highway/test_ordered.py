"""Cars that an attacker drives obey within the bounds, which the engine enforces; without orders nothing is different."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cavbench.driving.sets import Traffic
from cavbench.driving.surroundings import Surroundings
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.config import HighwayConfig
from cavbench.envs.highway.engine import HighwayEngine
from cavbench.envs.highway.ordered import BRAKED, GENTLE, MOVED, REFUSED, TAKEN

CELLS = tuple(AXES.cell(lanes=lanes, density=density) for lanes in (3, 4) for density in (1.0, 2.0)) * 6
BATCH = len(CELLS)
BOUNDS = Traffic(cars=2, acceleration=2.0, braking=5.0, lateral_speed=1.2, gap=4.0, headway=0.2, closing=6.0)
SETTLED = 15
"""Frames."""
IDLE = np.ones(BATCH, np.int64)


def engine(traffic: Traffic | None = BOUNDS, **values: Any) -> HighwayEngine:
    made = HighwayEngine(HighwayConfig(cells=CELLS, traffic=traffic, **values))
    made.reset(np.arange(BATCH), np.arange(BATCH) + 77)
    return made


def orders(made: HighwayEngine, number: int, acceleration: float, y: float) -> np.ndarray:
    given = np.zeros((*made.vehicles.shape, 3))
    given[:, number] = (1, acceleration, y)
    return given


def test_wild_orders_stay_within_the_bounds() -> None:
    made, generator = engine(), np.random.default_rng(0)
    dt, held = 1 / made.config.simulation_frequency, np.zeros(made.vehicles.shape, int)
    for step in range(150):
        given = np.zeros((*made.vehicles.shape, 3))
        if step % 5 == 0:
            wild = generator.uniform(-1, 1, (*made.vehicles.shape, 2)) * (50, 30)
        given[..., 0] = generator.random(made.vehicles.shape) < 0.3 if step % 50 == 0 else made.vehicles["ordered"]
        given[..., 1:] = wild
        before = made.vehicles.copy()
        made.order_cars(given)
        made.step(IDLE)
        after = made.vehicles
        driven = after["ordered"] & ~after["crashed"] & ~before["crashed"]
        assert (after["ordered"].sum(1) <= BOUNDS.cars).all()
        assert not after["ordered"][:, 0].any()
        gained = (after["speed"] - before["speed"])[driven] / dt
        assert gained.max(initial=0) <= BOUNDS.acceleration + 1e-9
        assert gained.min(initial=0) >= -BOUNDS.braking - 1e-9
        held = np.where(driven, held + 1, 0)
        # A car that was changing lane by itself when it was taken needs a moment to become slower.
        across = np.abs(after["y"] - before["y"])[held > SETTLED] / dt
        assert across.max(initial=0) <= BOUNDS.lateral_speed + 1e-9
        assert after["speed"][driven].min(initial=0) >= -1e-9
        on_road = 4 * (made.episodes["lanes"][:, None] - 1) + 1
        assert ((after["y"] > -1) & (after["y"] < on_road))[driven].all()
    assert made.orders[:, TAKEN].min() >= 2
    assert made.orders[:, REFUSED].sum() > made.orders[:, MOVED].sum() > 0


def test_a_manoeuvre_begins_only_with_room() -> None:
    made = engine()
    for _ in range(20):
        made.order_cars(orders(made, 1, -9.0, 4.0))
        before = made.orders.copy()
        cars, ego = made.vehicles[:, 1], made.vehicles[:, 0]
        close = (cars["x"] > ego["x"]) & (np.abs(cars["y"] - ego["y"]) < 2)
        gap = cars["x"] - ego["x"] - 5
        tight = close & (gap < BOUNDS.gap + BOUNDS.headway * ego["speed"])
        assert not (cars["braking"] & tight & (before[:, BRAKED] == 0)).any()
        assert (cars["ordered_acceleration"][tight & ~cars["braking"]] >= -GENTLE).all()
        made.step(IDLE)
    assert made.orders[:, BRAKED].max() == 1, "one braking, however long"


def test_a_car_that_drives_fast_does_not_run_into_the_car_ahead() -> None:
    made = engine(replace(BOUNDS, cars=1))
    hit = np.zeros(BATCH, bool)
    for _ in range(200):
        made.order_cars(orders(made, 3, 9.0, 0.0))
        made.step(IDLE)
        hit |= made.vehicles["crashed"][:, 3] & ~made.vehicles["crashed"][:, 0]
    assert hit.mean() < 0.1


@pytest.mark.parametrize("given", ["none", "empty", "not finite"])
def test_without_orders_every_bit_is_the_same(given: str) -> None:
    plain, made = engine(None), engine()
    action = np.random.default_rng(1).choice(5, (120, BATCH))
    for one in action:
        if given != "none":
            made.order_cars(np.full((*made.vehicles.shape, 3), 0.0 if given == "empty" else np.nan))
        plain.step(one)
        made.step(one)
        assert plain.observation.tobytes() == made.observation.tobytes()
    assert plain.vehicles.tobytes() == made.vehicles.tobytes()


def test_a_released_car_drives_on_by_itself() -> None:
    made = engine()
    made.order_cars(orders(made, 1, -3.0, 0.0))
    made.step(IDLE)
    assert made.vehicles["ordered"][:, 1].all()
    made.order_cars(np.zeros((*made.vehicles.shape, 3)))
    assert not made.vehicles["ordered"].any()


def test_rude_traffic_keeps_less_distance_and_a_heavy_ego_brakes_less() -> None:
    rude = Surroundings(time_gap=0.5, jam_distance=7.0, lane_gain=-0.5, imposed_braking=6.0, reaction=0.4)
    gaps = []
    for surroundings in (Surroundings(), rude):
        made = engine(None, surroundings=surroundings, driver="idm")
        for _ in range(300):
            made.step(IDLE)
        x, y = made.vehicles["x"][:, 1:], made.vehicles["y"][:, 1:]
        ahead = x[:, None, :] - x[:, :, None]
        ahead = np.where((ahead > 0) & (np.abs(y[:, None, :] - y[:, :, None]) < 2), ahead, np.inf).min(2)
        gaps.append(np.quantile(ahead[np.isfinite(ahead)], 0.1))
    assert gaps[1] < 0.8 * gaps[0]
    slowed = []
    for surroundings in (Surroundings(), Surroundings(mass=2.0), Surroundings(friction=0.2)):
        made = engine(None, surroundings=surroundings)
        for _ in range(8):
            made.step(np.full(BATCH, 4))
        slowed.append(25 - made.vehicles["speed"][:, 0].mean())
    assert slowed[1] < 0.8 * slowed[0]
    assert slowed[2] <= 0.2 * 9.81 * 8 / 15 + 1e-6
