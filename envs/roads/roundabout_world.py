"""The world `roundabout`: a ring of two lanes with four arms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cavbench.driving import Features
from cavbench.envs.roads import roundabout
from cavbench.envs.roads.axes import ROUNDABOUT, ROUNDABOUT_V1
from cavbench.envs.roads.config import Scene, TaskKind
from cavbench.envs.roads.network import record
from cavbench.envs.roads.state import Measure
from cavbench.envs.roads.world import PLANE, RoadsWorld
from cavbench.scenarios import Axes, Cell

GOALS = {"right": roundabout.RIGHT, "straight": roundabout.STRAIGHT, "left": roundabout.LEFT}
CARS = 4
"""highway-env's other cars."""
SPEEDS = (0.0, 8.0, 16.0)


@cache
def _road(turn: str, radius: float, connected: bool) -> NDArray[np.void]:
    """The network of a cell. It is cached because the engine tells roads apart by their identity."""
    network = roundabout.roundabout(connected=connected, radius=radius)
    way = roundabout.way(GOALS[turn])
    return record(network, spots=roundabout.spots(network), destinations=roundabout.DESTINATIONS, way=way)


@dataclass(frozen=True, kw_only=True)
class RoundaboutWorld(RoadsWorld):
    """A roundabout with two lanes and four arms: highway-env 1.12.1's `roundabout`, 15 Hz, at most 30 seconds."""

    name: ClassVar[str] = ROUNDABOUT_V1.world
    axes: ClassVar[Axes] = ROUNDABOUT
    grid: ClassVar[str] = ROUNDABOUT_V1.name
    features: ClassVar[Features] = PLANE
    home: ClassVar[Cell] = ROUNDABOUT.cell(turn="straight", density=1.0, radius=20.0)
    rules: ClassVar[Mapping[str, Any]] = {
        "task": TaskKind.ROUNDABOUT,
        "progress": Measure.WAY,
        "reference_speed": SPEEDS[-1],
        "odometer": True,
        "shoulder": 1.0,
    }

    target_speeds: tuple[float, ...] = SPEEDS
    max_steps: int = 450

    def scene(self, cell: Cell) -> Scene:
        cars = max(1, round(CARS * cell.density))
        road = _road(cell.turn, float(cell.radius), self.connected)
        return Scene(road=road, traffic=cars, capacity=cars + 1, goal=GOALS[cell.turn])
