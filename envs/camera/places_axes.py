"""The axes of the ten places, and their standard grid."""

from __future__ import annotations

from cavbench.scenarios import Axes, Axis, Grid

AXES = Axes(
    (
        Axis(
            name="weather",
            kind="str",
            meaning="air and light",
            choices=("clear", "rain", "fog"),
            default="clear",
            perceptual=True,
        ),
    )
)
PLACES_V1 = Grid(
    name="places-v1",
    world="places",
    axes=AXES,
    values={"weather": ("clear", "rain", "fog")},
    episodes=10,
)
