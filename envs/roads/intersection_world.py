"""The world `intersection`: a crossing of two roads, one of which has the right of way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cavbench.driving import Features
from cavbench.envs.roads import intersection
from cavbench.envs.roads.axes import INTERSECTION, INTERSECTION_V1
from cavbench.envs.roads.config import Scene, TaskKind
from cavbench.envs.roads.network import record
from cavbench.envs.roads.state import Measure
from cavbench.envs.roads.world import PLANE, RoadsWorld
from cavbench.scenarios import Axes, Cell

GOALS = {"left": 1, "straight": 2, "right": 3}
CARS, ARRIVALS = 10, 0.6
"""highway-env's cars at the start, of which some find no room, and its chance that one comes in a second."""
CAPACITY = 64
SPEEDS = (0.0, 4.5, 9.0)


@cache
def _road(turn: str, connected: bool) -> NDArray[np.void]:
    """The network of a cell. It is cached because the engine tells roads apart by their identity."""
    network = intersection.intersection(connected=connected)
    way = intersection.way(GOALS[turn])
    return record(network, spots=intersection.spots(network), destinations=intersection.DESTINATIONS, way=way)


@dataclass(frozen=True, kw_only=True)
class IntersectionWorld(RoadsWorld):
    """A crossing where the ego must give way: highway-env 1.12.1's `intersection`, 15 Hz, at most 20 seconds."""

    name: ClassVar[str] = INTERSECTION_V1.world
    axes: ClassVar[Axes] = INTERSECTION
    grid: ClassVar[str] = INTERSECTION_V1.name
    features: ClassVar[Features] = PLANE
    home: ClassVar[Cell] = INTERSECTION.cell(turn="left", density=1.0)
    rules: ClassVar[Mapping[str, Any]] = {
        "task": TaskKind.INTERSECTION,
        "reward_speed_range": (7.0, 9.0),
        "idm": (6.0, 3.0, 7.0),
        "regulated": True,
        "progress": Measure.WAY,
        "reference_speed": SPEEDS[-1],
        "odometer": True,
    }

    target_speeds: tuple[float, ...] = SPEEDS

    def scene(self, cell: Cell) -> Scene:
        return Scene(
            road=_road(cell.turn, self.connected),
            traffic=max(2, round(CARS * cell.density)),
            capacity=CAPACITY,
            arrivals=ARRIVALS * cell.density / self.policy_frequency,
            goal=GOALS[cell.turn],
        )
