"""Projected light: a pattern of light on the sign that hides it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from cavbench.attacks.detection.shaped import ShapedEOT
from cavbench.detection.mount import Shape


@dataclass(frozen=True, kw_only=True)
class ProjectedLight(ShapedEOT):
    """Light on the sign, as of a projector (SLAP, Lovisotto et al. 2021, arXiv 2007.04137): it adds, and takes nothing away.

    `eot` with other defaults, under `threat.shape=light`. The budget bounds the added light as a share of the light on the sign.

    The parameters are those of `eot`.

    Queries: restarts * steps * batch images.

    Example:
        >>> from cavbench.attacks.detection.projected import ProjectedLight
        >>> coarse = ProjectedLight(texels=25)
    """

    shape: ClassVar[Shape] = "light"
