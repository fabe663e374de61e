"""The axes of the camera world, and its standard grid."""

from __future__ import annotations

from cavbench.scenarios import Axes, Axis, Grid

AXES = Axes(
    (
        Axis(
            name="lanes",
            kind="int",
            meaning="number of lanes: more lanes put the sign farther to the right",
            choices=(3, 4, 5),
        ),
        Axis(name="density", kind="float", meaning="traffic density: cars may hide the sign", choices=(1.0, 2.0)),
        Axis(
            name="weather",
            kind="str",
            meaning="air and light",
            choices=("clear", "rain", "fog", "night"),
            default="clear",
            perceptual=True,
        ),
    )
)

APPROACH_V1 = Grid(
    name="approach-v1",
    world="camera",
    axes=AXES,
    values={"lanes": (3, 4, 5), "density": (1.0, 2.0), "weather": ("clear", "rain", "fog")},
    episodes=3,
)
