"""The world `u_turn`: there on one side, round a half circle, and back on the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cavbench.driving import Features
from cavbench.driving.way import Way
from cavbench.envs.roads import u_turn
from cavbench.envs.roads.axes import U_TURN, U_TURN_V1
from cavbench.envs.roads.bends import way_round
from cavbench.envs.roads.config import Scene, TaskKind
from cavbench.envs.roads.network import record
from cavbench.envs.roads.state import Measure
from cavbench.envs.roads.world import PLANE, RoadsWorld
from cavbench.scenarios import Axes, Cell

CARS = 6
"""highway-env's other cars."""
SPEEDS = (0.0, 8.0, 16.0, 24.0)


@cache
def _road(connected: bool) -> NDArray[np.void]:
    """The network. It is cached because the engine tells roads apart by their identity."""
    network = u_turn.u_turn(connected=connected)
    return record(network, spots=u_turn.spots(network), destinations=u_turn.DESTINATIONS, way=u_turn.WAY)


@cache
def _way(connected: bool) -> Way:
    """The ego starts at the beginning of the left lane."""
    return way_round(u_turn.u_turn(connected=connected), u_turn.WAY.roads, start=0.0, start_lane=0)


@dataclass(frozen=True, kw_only=True)
class UTurnWorld(RoadsWorld):
    """A U-turn around slower cars: highway-env 1.12.1's `u-turn`, 15 Hz, at most 30 seconds."""

    name: ClassVar[str] = U_TURN_V1.world
    axes: ClassVar[Axes] = U_TURN
    grid: ClassVar[str] = U_TURN_V1.name
    features: ClassVar[Features] = PLANE
    home: ClassVar[Cell] = U_TURN.cell(density=1.0)
    rules: ClassVar[Mapping[str, Any]] = {
        "task": TaskKind.U_TURN,
        "reward_speed_range": (8.0, 24.0),
        "progress": Measure.WAY,
        "reference_speed": SPEEDS[-1],
        "odometer": True,
        "shoulder": 1.0,
    }

    start_speed: ClassVar[float | None] = 16.0
    target_speeds: tuple[float, ...] = SPEEDS
    max_steps: int = 450

    @property
    def way(self) -> Way:
        return _way(self.connected)

    def scene(self, cell: Cell) -> Scene:
        cars = max(1, round(CARS * cell.density))
        return Scene(road=_road(self.connected), traffic=cars, capacity=cars + 1)
