"""Scenes that a reader can judge on paper, for tests of blame: cars are put where a test says, and drive on the real engine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pytest

from cavbench.driving.blame import Deeds
from cavbench.driving.sets import Traffic
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.blame import blame
from cavbench.envs.highway.config import HighwayConfig
from cavbench.envs.highway.engine import HighwayEngine

LANE_WIDTH = 4.0
FREE = Traffic(cars=1, braking=9.0, gap=0.0, headway=0.0, closing=80.0, lateral_speed=4.0)
"""Bounds that refuse nothing that these scenes order."""


class Car(NamedTuple):
    """A car at the start."""

    ahead: float
    """m from the centre of the victim's car to its own."""
    lane: int
    speed: float
    """m/s"""


Command = Callable[[int], Sequence[float]]
"""From the decision, what the car 1 is ordered: acceleration in m/s2, and where it steers to, in m."""


def judged(
    monkeypatch: pytest.MonkeyPatch, cars: Sequence[Car], *, lanes: int, action: int, command: Command | None = None
) -> tuple[dict[str, float], int]:
    """Drive a scene in which the victim only does `action`, until it crashes: the columns of blame, and the decisions.

    The first car is the victim's own.
    """
    config = HighwayConfig(cells=(AXES.cell(lanes=lanes, density=1.0),), traffic=FREE, vehicles=len(cars) - 1)
    start = HighwayEngine.reset

    def placed(engine: HighwayEngine, chosen: np.ndarray, seeds: np.ndarray) -> None:
        start(engine, chosen, seeds)
        now = engine.vehicles[0]
        now["x"] = [200 + car.ahead for car in cars]
        now["lane"] = now["target_lane"] = [car.lane for car in cars]
        now["y"] = [LANE_WIDTH * car.lane for car in cars]
        now["speed"] = [car.speed for car in cars]
        now["target_speed"][1:] = now["speed"][1:]
        engine.order[0] = np.argsort(now["x"])

    monkeypatch.setattr(HighwayEngine, "reset", placed)
    engine, deeds = HighwayEngine(config), Deeds(np.array([500]))
    engine.reset(np.arange(1), deeds.seeds)
    while not engine.episodes["terminated"][0]:
        orders = np.zeros((1, len(cars), 3))
        if command is not None:
            orders[0, 1] = 1, *command(len(deeds.actions))
        deeds.actions.append(np.array([action]))
        deeds.orders.append(orders)
        engine.order_cars(orders)
        engine.step(deeds.actions[-1])
        assert len(deeds.actions) < 200, "the scene must end in a crash"
    assert engine.episodes["crashed"][0]
    found = blame(config, deeds, engine.episodes["steps"].copy(), np.array([True]))
    return {name: float(values[0]) for name, values in found.items()}, len(deeds.actions)
