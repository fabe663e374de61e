"""The axes of the worlds of road networks, and their grids."""

from __future__ import annotations

from cavbench.envs.highway.axes import AXES as HIGHWAY
from cavbench.scenarios import Axes, Axis, Grid

WEATHER = HIGHWAY["weather"]

MERGE = Axes(
    (
        Axis(
            name="density",
            kind="float",
            meaning="traffic on the motorway: 1 is highway-env's three cars on the 310 m up to the end of the ramp",
            above=0.0,
            high=4.0,
        ),
        Axis(
            name="ramp",
            kind="float",
            meaning="length of the ramp's lane beside the motorway in m: highway-env's parallel_merge_length",
            low=20.0,
            high=400.0,
        ),
        WEATHER,
    )
)

MERGE_V1 = Grid(
    name="merge-v1",
    world="merge",
    axes=MERGE,
    values={"density": (2.0, 4.0), "ramp": (40.0, 80.0), "weather": ("clear", "rain", "fog")},
    episodes=30,
    block=10,
    training_seeds=10,
)
"""Half and all of highway-env's ramp, at two and four times its traffic: at its own, a car that keeps its speed scores 0.95."""
