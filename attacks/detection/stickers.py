"""Stickers: four small patches on the sign that hide it together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from cavbench.attacks.detection.shaped import ShapedEOT
from cavbench.core.ranges import NotNegative
from cavbench.detection.mount import Shape


@dataclass(frozen=True, kw_only=True)
class Stickers(ShapedEOT):
    """Robust physical perturbations (Eykholt et al. 2018, arXiv 1707.08945): stickers above and below the word.

    `eot` with other defaults, under `threat.shape=stickers`: four squares that together cover as much as the one of the same
    budget. As there, the non-printability score is a part of the loss.

    Args:
        nps: weight of the non-printability score (default 0.1).

    The other parameters are those of `eot`.

    Queries: restarts * steps * batch images.

    Example:
        >>> from cavbench.attacks.detection.stickers import Stickers
        >>> any_colour = Stickers(nps=0)
    """

    shape: ClassVar[Shape] = "stickers"

    nps: NotNegative = 0.1
