"""The axes of the world `windscreen`, and its standard grid."""

from __future__ import annotations

from cavbench.envs.camera.axes import AXES as STREET_AXES
from cavbench.scenarios import Axes, Axis, Grid

LENSES = ("clean", "drops", "glare", "blur")

LENS = Axis(
    name="lens",
    kind="str",
    meaning="what is between the street and the sensor",
    choices=LENSES,
    default="clean",
    perceptual=True,
)
AXES = Axes((*STREET_AXES.values(), LENS))

WINDSCREEN_V1 = Grid(
    name="windscreen-v1",
    world="windscreen",
    axes=AXES,
    values={"lanes": (3, 4, 5), "density": (1.0,), "weather": ("clear", "rain"), "lens": LENSES},
    episodes=3,
)
