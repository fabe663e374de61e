"""The axes of photographs, and their grid."""

from __future__ import annotations

from cavbench.scenarios import Axes, Axis, Grid

AXES = Axes(
    (
        Axis(
            name="light",
            kind="str",
            meaning="the light is that of the pictures",
            choices=("as_taken",),
            default="as_taken",
        ),
    )
)
PHOTOS_V1 = Grid(name="photos-v1", world="photos", axes=AXES, values={"light": ("as_taken",)}, episodes=1)
