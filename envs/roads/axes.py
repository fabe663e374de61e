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
TURN = Axis(
    name="turn",
    kind="str",
    meaning="where the ego goes; it comes from the south, and the traffic drives on the right",
    choices=("right", "straight", "left"),
    default="straight",
)

ROUNDABOUT = Axes(
    (
        TURN,
        Axis(
            name="density",
            kind="float",
            meaning="traffic: 1 is highway-env's four cars; what is more comes from the other three arms",
            above=0.0,
            high=4.0,
        ),
        Axis(
            name="radius",
            kind="float",
            meaning="radius of the ring's inner lane in m; highway-env's is 20",
            low=16.0,
            high=45.0,
            default=20.0,
        ),
        WEATHER,
    )
)

ROUNDABOUT_V1 = Grid(
    name="roundabout-v1",
    world="roundabout",
    axes=ROUNDABOUT,
    values={
        "turn": ("straight", "left"),
        "density": (1.0, 2.0),
        "radius": (20.0,),
        "weather": ("clear", "rain", "fog"),
    },
    episodes=30,
    block=10,
    training_seeds=10,
)
"""Straight on and to the left on highway-env's ring, with its traffic and twice of it."""

INTERSECTION = Axes(
    (
        TURN,
        Axis(
            name="density",
            kind="float",
            meaning="traffic: 1 is highway-env's ten cars at the start, of which six find a place, and 0.6 a second after it",
            above=0.0,
            high=3.0,
        ),
        WEATHER,
    )
)

INTERSECTION_V1 = Grid(
    name="intersection-v1",
    world="intersection",
    axes=INTERSECTION,
    values={"turn": ("left", "straight"), "density": (1.0, 2.0), "weather": ("clear", "rain", "fog")},
    episodes=30,
    block=10,
    training_seeds=10,
)
"""highway-env's left turn, and straight on, with its traffic and twice of it."""

EXIT = Axes(
    (
        Axis(name="lanes", kind="int", meaning="lanes of the motorway; highway-env has 6", low=2, high=6, default=6),
        Axis(
            name="density",
            kind="float",
            meaning="divisor of the distances between the twenty cars; highway-env's is 1.5",
            above=0.0,
            high=3.0,
            default=1.5,
        ),
        WEATHER,
    )
)

EXIT_V1 = Grid(
    name="exit-v1",
    world="exit",
    axes=EXIT,
    values={"lanes": (4, 6), "density": (1.0, 1.5), "weather": ("clear", "rain", "fog")},
    episodes=30,
    block=10,
    training_seeds=10,
)
"""highway-env's six lanes and four, in its traffic and in thinner traffic."""

TWO_WAY = Axes(
    (
        Axis(
            name="density",
            kind="float",
            meaning="slow cars ahead: 1 is highway-env's distance of 40 m between them",
            above=0.0,
            high=2.0,
        ),
        Axis(
            name="oncoming",
            kind="float",
            meaning="oncoming cars: 1 is highway-env's distance of 100 m between them",
            above=0.0,
            high=4.0,
            default=1.0,
        ),
        WEATHER,
    )
)

TWO_WAY_V1 = Grid(
    name="two-way-v1",
    world="two_way",
    axes=TWO_WAY,
    values={"density": (0.5, 1.0), "oncoming": (0.5, 1.0), "weather": ("clear", "rain", "fog")},
    episodes=30,
    block=10,
    training_seeds=10,
)
"""highway-env's distances and twice of them."""

RACETRACK = Axes(
    (
        Axis(
            name="cars", kind="int", meaning="other cars on the circuit; highway-env has 1", low=1, high=12, default=1
        ),
        WEATHER,
    )
)

RACETRACK_V1 = Grid(
    name="racetrack-v1",
    world="racetrack",
    axes=RACETRACK,
    values={"cars": (1, 4, 8), "weather": ("clear", "rain", "fog")},
    episodes=30,
    block=10,
    training_seeds=10,
)
"""highway-env's one other car, four, and eight."""

U_TURN = Axes(
    (
        Axis(
            name="density",
            kind="float",
            meaning="traffic: 1 is highway-env's six cars; what is more is anywhere on the road",
            above=0.0,
            high=3.0,
        ),
        WEATHER,
    )
)

U_TURN_V1 = Grid(
    name="u-turn-v1",
    world="u_turn",
    axes=U_TURN,
    values={"density": (1.0, 2.0), "weather": ("clear", "rain", "fog")},
    episodes=30,
    block=10,
    training_seeds=10,
)
"""highway-env's six cars and twelve."""
