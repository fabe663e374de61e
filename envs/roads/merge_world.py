"""The world `merge`: a motorway of two lanes with an on-ramp."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.roads.axes import MERGE, MERGE_V1
from cavbench.envs.roads.config import Scene, TaskKind
from cavbench.envs.roads.merge import UNUSED_AFTER, generic, spots
from cavbench.envs.roads.network import record
from cavbench.envs.roads.world import RoadsWorld
from cavbench.scenarios import Axes, Cell

LANES = 2
BEFORE, CONVERGE, AFTER = 150.0, 80.0, 900.0
"""Lengths of the motorway in m: highway-env's before the merge, and after it more than a car drives in 20 s."""
CARS = 3
"""highway-env's cars on the motorway, besides the ego and the car on the ramp."""


@cache
def _road(ramp: float, connected: bool) -> NDArray[np.void]:
    """The network of a cell. It is cached because the engine tells roads apart by their identity."""
    network = generic(lanes=LANES, before=BEFORE, converge=CONVERGE, parallel=ramp, after=AFTER, connected=connected)
    return record(network, spots=spots(network), end=BEFORE + CONVERGE + ramp + AFTER - UNUSED_AFTER)


@dataclass(frozen=True, kw_only=True)
class MergeWorld(RoadsWorld):
    """A motorway with an on-ramp that ends: highway-env 1.12.1's `merge-generic`, 15 Hz, 20 seconds."""

    name: ClassVar[str] = MERGE_V1.world
    axes: ClassVar[Axes] = MERGE
    grid: ClassVar[str] = MERGE_V1.name
    home: ClassVar[Cell] = MERGE.cell(density=1.0, ramp=80.0)
    rules: ClassVar[Mapping[str, Any]] = {"task": TaskKind.MERGE_GENERIC}
    start_speed: ClassVar[float | None] = 30.0

    def scene(self, cell: Cell) -> Scene:
        cars = max(1, round(CARS * cell.density))
        return Scene(road=_road(float(cell.ramp), self.connected), traffic=cars, capacity=cars + 3)
