"""Materials of surfaces, independent of the renderer."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from cavbench.envs.camera.street.textures import Colour, Texture

Kind = Literal["matt", "paving", "road", "paint", "glass", "metal", "lamp", "sign"]


@dataclass(frozen=True, eq=False)
class Material:
    """A surface.

    Args:
        kind: how it reflects; `paving` and `road` are darker and glossier when wet, `lamp` emits light.
        colour: linear reflectance, or radiance of a `lamp`.
        texture: linear reflectance; replaces `colour`.
    """

    kind: Kind
    colour: Colour = (0.5, 0.5, 0.5)
    texture: Texture | None = field(default=None, repr=False)


RUBBER = Material("matt", (0.02, 0.02, 0.02))
GLASS = Material("glass", (0.02, 0.025, 0.03))
STEEL = Material("metal", (0.5, 0.5, 0.5))
CHROME = Material("metal", (0.75, 0.75, 0.75))
MARKING = Material("paving", (0.56, 0.56, 0.53))
TAIL_LIGHT = Material("paint", (0.35, 0.01, 0.01))
TAIL_LIGHT_LIT = Material("lamp", (1.6, 0.05, 0.03))
PLATE = Material("matt", (0.6, 0.6, 0.55))
BARK = Material("matt", (0.09, 0.065, 0.045))
HILLS = Material("matt", (0.05, 0.075, 0.04))
