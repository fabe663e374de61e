"""Cars on a road from above."""

from __future__ import annotations

from collections.abc import Iterable

from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from cavbench.envs.highway.dynamics import LANE_WIDTH, VEHICLE_LENGTH, VEHICLE_WIDTH
from docs.figures import style

Place = tuple[float, float]
"""Position along and across the road in m; the centre of lane i is at 4 i."""


def lanes(axes: Axes, count: int, reach: tuple[float, float]) -> None:
    """Draw the lines of a road, and an axis along it."""
    for line in range(count + 1):
        edge = line in (0, count)
        axes.axhline(
            (line - 0.5) * LANE_WIDTH, color=style.GREY, lw=1.2 if edge else 0.8, ls="-" if edge else (0, (6, 6))
        )
    axes.set(xlim=reach, ylim=((count - 0.5) * LANE_WIDTH + 0.6, -0.5 * LANE_WIDTH - 0.6), yticks=[])
    axes.spines[["left", "bottom"]].set_visible(False)


def cars(axes: Axes, places: Iterable[Place], colour: str, *, filled: bool = True) -> None:
    """Draw a rectangle of a car's size at each position."""
    for x, y in places:
        corner = x - VEHICLE_LENGTH / 2, y - VEHICLE_WIDTH / 2
        face = colour if filled else "none"
        axes.add_patch(Rectangle(corner, VEHICLE_LENGTH, VEHICLE_WIDTH, facecolor=face, edgecolor=colour, lw=1.6))
