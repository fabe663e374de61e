"""The axes of the worlds with SUMO's traffic, and their grids."""

from __future__ import annotations

from cavbench.envs.highway.axes import AXES as HIGHWAY
from cavbench.scenarios import Axes, Axis, Grid

SUMO = Axes(
    (
        Axis(name="lanes", kind="int", meaning="lanes of the motorway, without the ramp's", low=2, high=4),
        Axis(
            name="density",
            kind="float",
            meaning="divisor of the distances between cars: at 1 on three lanes a car every 76 m of each lane",
            above=0.0,
            high=3.0,
        ),
        HIGHWAY["weather"],
    )
)

SUMO_V1 = Grid(
    name="sumo-v1",
    world="sumo",
    axes=SUMO,
    values={"lanes": (2, 3), "density": (1.0, 2.0), "weather": ("clear", "rain", "fog")},
    episodes=30,
    block=10,
    training_seeds=10,
)
"""A motorway of two and of three lanes, in traffic as on `highway` and in twice as dense traffic."""
