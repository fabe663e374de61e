"""The way of the ego on a road that bends: straight and circular stretches, one after the other, with parallel lanes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

FITS = 1e-3
"""Stretches meet up to this, in m and rad."""


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

    @property
    def end(self) -> tuple[float, float, float]:
        """The point x, y where it ends, and the direction there."""
        heading = self.heading + self.curvature * self.length
        if self.curvature == 0:
            return (
                self.x + self.length * math.cos(heading),
                self.y + self.length * math.sin(heading),
                heading,
            )
        return (
            self.x + (math.sin(heading) - math.sin(self.heading)) / self.curvature,
            self.y - (math.cos(heading) - math.cos(self.heading)) / self.curvature,
            heading,
        )


@dataclass(frozen=True, kw_only=True)
class Way:
    """The stretches that all cars follow. A place is a station, in m along the left lane, and an offset to its right, in m.

    It goes on straight beyond both of its ends.

    Args:
        stretches: in driving order.
        lanes: number of lanes; lane i has the offset i times `Kinematics.lane_width`.
        start, start_lane: the station and the lane at which the ego starts, in every episode. A measurement can be forged.

    Raises:
        ValueError: if the first or the last stretch is not straight, or one does not begin where the one before ends.
    """

    stretches: tuple[Stretch, ...]
    lanes: int
    start: float
    start_lane: int

    def __post_init__(self) -> None:
        if not self.stretches or self.stretches[0].curvature or self.stretches[-1].curvature:
            raise ValueError("a way begins and ends with a straight stretch")
        for one, after in pairwise(self.stretches):
            x, y, heading = one.end
            turned = math.remainder(heading - after.heading, 2 * math.pi)
            if math.hypot(x - after.x, y - after.y) > FITS or abs(turned) > FITS:
                raise ValueError("each stretch of a way begins where the one before ends, in its direction")

    @cached_property
    def stations(self) -> tuple[float, ...]:
        """Where each stretch begins, in m."""
        return tuple(math.fsum(one.length for one in self.stretches[:number]) for number in range(len(self.stretches)))

    @cached_property
    def sharpest(self) -> float:
        """The largest curvature of the left lane, to either side, in rad/m."""
        return max(abs(one.curvature) for one in self.stretches)
