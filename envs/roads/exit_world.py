"""The world `exit`: a motorway that the ego must leave."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cavbench.driving import Features
from cavbench.envs.highway.config import WIDE_FEATURES
from cavbench.envs.roads import exit as leave
from cavbench.envs.roads.axes import EXIT, EXIT_V1
from cavbench.envs.roads.config import Scene, TaskKind
from cavbench.envs.roads.network import record
from cavbench.envs.roads.state import Measure
from cavbench.envs.roads.world import RoadsWorld
from cavbench.scenarios import Axes, Cell

CARS = 20
"""highway-env's other cars."""


@cache
def _road(lanes: int, connected: bool) -> NDArray[np.void]:
    """The network of a cell. It is cached because the engine tells roads apart by their identity."""
    network = leave.exit_road(lanes=lanes, connected=connected)
    return record(
        network,
        spots=leave.spots(network),
        destinations=leave.DESTINATIONS,
        factor=leave.spacing_factor(lanes),
        way=leave.WAY,
    )


@dataclass(frozen=True, kw_only=True)
class ExitWorld(RoadsWorld):
    """A motorway that the ego must leave by the exit on the right: highway-env 1.12.1's `exit`, 15 Hz, at most 20 seconds."""

    name: ClassVar[str] = EXIT_V1.world
    axes: ClassVar[Axes] = EXIT
    grid: ClassVar[str] = EXIT_V1.name
    features: ClassVar[Features] = WIDE_FEATURES
    lane_changes: ClassVar[bool] = False
    home: ClassVar[Cell] = EXIT.cell(lanes=6, density=1.5)
    rules: ClassVar[Mapping[str, Any]] = {"task": TaskKind.EXIT, "progress": Measure.WAY}
    start_speed: ClassVar[float | None] = 25.0

    def scene(self, cell: Cell) -> Scene:
        return Scene(road=_road(cell.lanes, self.connected), traffic=CARS, density=cell.density, capacity=CARS + 1)
