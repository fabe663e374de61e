"""The world `racetrack`: a circuit of two lanes with slower cars."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cavbench.driving import Features
from cavbench.envs.roads import racetrack
from cavbench.envs.roads.axes import RACETRACK, RACETRACK_V1
from cavbench.envs.roads.config import Scene, TaskKind
from cavbench.envs.roads.network import record
from cavbench.envs.roads.state import Measure
from cavbench.envs.roads.world import PLANE, RoadsWorld
from cavbench.scenarios import Axes, Cell

SPEEDS = (0.0, 5.0, 10.0, 15.0)


@cache
def _road(connected: bool) -> NDArray[np.void]:
    """The network. It is cached because the engine tells roads apart by their identity."""
    network = racetrack.racetrack(connected=connected)
    return record(network, spots=racetrack.spots(network))


@dataclass(frozen=True, kw_only=True)
class RacetrackWorld(RoadsWorld):
    """A circuit with slower cars: the track of highway-env 1.12.1's `racetrack`, 15 Hz, 20 seconds."""

    name: ClassVar[str] = RACETRACK_V1.world
    axes: ClassVar[Axes] = RACETRACK
    grid: ClassVar[str] = RACETRACK_V1.name
    features: ClassVar[Features] = PLANE
    home: ClassVar[Cell] = RACETRACK.cell(cars=1)
    rules: ClassVar[Mapping[str, Any]] = {
        "task": TaskKind.RACETRACK,
        "progress": Measure.LANE,
        "reference_speed": SPEEDS[-1],
        "odometer": True,
    }

    target_speeds: tuple[float, ...] = SPEEDS

    def scene(self, cell: Cell) -> Scene:
        return Scene(road=_road(self.connected), traffic=cell.cars, capacity=cell.cars + 1)
