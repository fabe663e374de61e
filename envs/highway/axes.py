"""The axes of the highway world, and its standard grid."""

from __future__ import annotations

from dataclasses import replace

from cavbench.scenarios import Axes, Axis, Grid

AXES = Axes(
    (
        Axis(name="lanes", kind="int", meaning="number of lanes", low=2, high=8),
        Axis(
            name="density",
            kind="float",
            meaning="traffic density: highway-env's vehicles_density, the divisor of the spacing",
            above=0.0,
            high=4.0,
        ),
        Axis(
            name="weather",
            kind="str",
            meaning="range and noise of the ego's sensor; there is no night, because it affects only cameras",
            choices=("clear", "rain", "fog"),
            default="clear",
            perceptual=True,
        ),
    )
)

STANDARD_V2 = Grid(
    name="standard-v2",
    world="highway",
    axes=AXES,
    values={"lanes": (3, 4, 5), "density": (1.0, 2.0), "weather": ("clear", "rain", "fog")},
    episodes=30,
    block=10,
    training_seeds=10,
)
"""The split between trainings and scenarios that makes intervals narrow at its cost (docs/statistics.md)."""

HIGHWAY_V0 = Grid(
    name="highway-env-v1",
    world="highway-v0",
    axes=AXES,
    values={"lanes": (3, 4, 5), "density": (1.0, 1.5), "weather": ("clear", "rain", "fog")},
    episodes=30,
    block=10,
    training_seeds=10,
)
"""highway-env's `highway-v0`, whose own road is lanes=4 density=1 weather=clear, and roads around it."""

FAST_V0 = replace(HIGHWAY_V0, name="highway-env-fast-v1", world="highway-fast-v0")
"""highway-env's `highway-fast-v0`, whose own road is lanes=3 density=1 weather=clear, and roads around it."""
