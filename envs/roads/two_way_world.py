"""The world `two_way`: slow cars ahead, and cars that come towards the ego on the lane for overtaking."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.roads import two_way
from cavbench.envs.roads.axes import TWO_WAY, TWO_WAY_V1
from cavbench.envs.roads.config import Scene, TaskKind
from cavbench.envs.roads.network import record
from cavbench.envs.roads.state import Measure
from cavbench.envs.roads.world import RoadsWorld
from cavbench.scenarios import Axes, Cell

LENGTH = 1200.0
"""Of the road in m: more than a car drives in 20 s."""
AHEAD, ONCOMING = 9, 6
"""Cars at density 1: at highway-env's distances of 40 and 100 m, but over 360 and 600 m."""


@cache
def _road(connected: bool) -> NDArray[np.void]:
    """The network. It is cached because the engine tells roads apart by their identity."""
    network = two_way.two_way(connected=connected, length=LENGTH)
    return record(network, spots=two_way.spots(network))


@dataclass(frozen=True, kw_only=True)
class TwoWayWorld(RoadsWorld):
    """A road with oncoming traffic on the lane for overtaking: highway-env 1.12.1's `two-way`, 15 Hz, 20 seconds."""

    name: ClassVar[str] = TWO_WAY_V1.world
    axes: ClassVar[Axes] = TWO_WAY
    grid: ClassVar[str] = TWO_WAY_V1.name
    lane_changes: ClassVar[bool] = False
    start_speed: ClassVar[float | None] = 30.0
    comes_towards: ClassVar[bool] = True
    home: ClassVar[Cell] = TWO_WAY.cell(density=1.0, oncoming=1.0)
    rules: ClassVar[Mapping[str, Any]] = {"task": TaskKind.TWO_WAY, "progress": Measure.LANE, "reference_speed": 30.0}

    def scene(self, cell: Cell) -> Scene:
        ahead, against = max(1, round(AHEAD * cell.density)), max(1, round(ONCOMING * cell.oncoming))
        return Scene(
            road=_road(self.connected),
            traffic=ahead,
            density=cell.density,
            oncoming=against,
            opposing=cell.oncoming,
            capacity=ahead + against + 1,
        )
