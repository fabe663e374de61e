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

CROSSING = Axes(
    (
        Axis(name="lanes", kind="int", meaning="lanes each way of the ego's road", low=1, high=3),
        Axis(
            name="density",
            kind="float",
            meaning="divisor of the distances between cars: at 1 a car every 60 m of each lane",
            above=0.0,
            high=2.5,
        ),
        Axis(
            name="rule",
            kind="str",
            meaning="who goes first: the road across (`yield`), or who came first",
            choices=("yield", "allway_stop"),
        ),
        HIGHWAY["weather"],
    )
)

SUMO_CROSSING_V1 = Grid(
    name="sumo_crossing-v1",
    world="sumo_crossing",
    axes=CROSSING,
    values={
        "lanes": (1, 2),
        "density": (1.0, 2.0),
        "rule": ("yield", "allway_stop"),
        "weather": ("clear", "rain", "fog"),
    },
    episodes=30,
    block=10,
    training_seeds=10,
)
"""A road of one and of two lanes each way, with gaps of five and of two and a half seconds in the traffic, under both rules."""
