"""The axes of the crossing, and its standard grid."""

from __future__ import annotations

from cavbench.envs.camera.windscreen_axes import LENS
from cavbench.scenarios import Axes, Axis, Grid

AXES = Axes(
    (
        Axis(
            name="weather",
            kind="str",
            meaning="air, light and the friction of the road",
            choices=("clear", "rain", "fog"),
            default="clear",
        ),
        Axis(
            name="speed",
            kind="float",
            meaning="speed of the car until it brakes",
            unit="m/s",
            low=4.0,
            high=14.0,
            default=10.0,
            unseen=True,
        ),
        LENS,
    )
)
CROSSING_V2 = Grid(
    name="crossing-v2",
    world="crossing",
    axes=AXES,
    values={"weather": ("clear", "rain", "fog"), "speed": (8.0, 10.0, 12.0), "lens": ("clean", "drops")},
    episodes=50,
)
