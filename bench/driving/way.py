"""The way of the ego on a road that bends: straight and circular stretches, one after the other, with parallel lanes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """A straight or circular piece of the left lane's centre line.

    Args:
        x, y: where it begins, in m; y points to the right of x.
        heading: direction there, in rad.
        length: in m.
        curvature: how the direction changes, in rad/m; more than 0 to the right.
    """

    x: float
    y: float
    heading: float
    length: float
    curvature: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Way:
    """The stretches that all cars follow. A place is a station, in m along the left lane, and an offset to its right, in m.

    An open way goes on straight beyond both of its ends. A closed one ends where it begins.

    Args:
        stretches: in driving order.
        lanes: number of lanes; lane i has the offset i times `Kinematics.lane_width`.
        start: the lowest and the highest station at which the ego starts.
        start_lane: the lane that it starts on; None if its first measurement says it.
        closed: whether the last stretch leads to the first one.
        misfit: by how much a place may be beside what the stretches say where one meets the next, in m.
        kink: by how much the direction may be beside it there, in rad.

    Raises:
        ValueError: if there is no stretch, or an end of an open way is not straight.
    """

    stretches: tuple[Stretch, ...]
    lanes: int
    start: tuple[float, float]
    start_lane: int | None = None
    closed: bool = False
    misfit: float = 0.0
    kink: float = 0.0

    def __post_init__(self) -> None:
        if not self.stretches:
            raise ValueError("a way has at least one stretch")
        if not self.closed and (self.stretches[0].curvature or self.stretches[-1].curvature):
            raise ValueError("an open way begins and ends with a straight stretch")

    @cached_property
    def stations(self) -> tuple[float, ...]:
        """Where each stretch begins, in m."""
        return tuple(math.fsum(one.length for one in self.stretches[:number]) for number in range(len(self.stretches)))

    @cached_property
    def length(self) -> float:
        """Of all stretches, in m."""
        return math.fsum(one.length for one in self.stretches)

    @cached_property
    def sharpest(self) -> float:
        """The largest curvature of the left lane, to either side, in rad/m."""
        return max(abs(one.curvature) for one in self.stretches)
