"""The lanes of a network as lines from above, for pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavbench.driving.features import LaneShape
from cavbench.envs.roads.network import LaneKind

POINTS = 24
"""Points of a lane that bends."""


def points(lane: np.void, across: float, count: int = POINTS) -> NDArray[np.float64]:
    """[count, 2] points along a record `LANE`, so many m to the right of its centre."""
    along = np.linspace(0, float(lane["length"]), count)
    if lane["kind"] == LaneKind.CIRCULAR:
        angle = lane["turn"] * along / lane["radius"] + lane["start_phase"]
        radius = lane["radius"] - across * lane["turn"]
        return np.stack([lane["center_x"] + radius * np.cos(angle), lane["center_y"] + radius * np.sin(angle)], 1)
    off = across + lane["amplitude"] * np.sin(lane["pulsation"] * along + lane["phase"])
    x = lane["start_x"] + along * lane["direction_x"] - off * lane["direction_y"]
    return np.stack([x, lane["start_y"] + along * lane["direction_y"] + off * lane["direction_x"]], 1)


def drawn(road: np.void) -> tuple[LaneShape, ...]:
    """Every lane of a record `ROAD`."""
    found = []
    for lane in road["lanes"][: road["lane_count"]]:
        count = 2 if lane["kind"] == LaneKind.STRAIGHT else POINTS
        line = tuple((float(x), float(y)) for x, y in points(lane, 0.0, count))
        found.append(LaneShape(width=float(lane["width"]), line=line))
    return tuple(found)
