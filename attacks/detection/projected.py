"""Projected light: a pattern of light on the sign that hides it."""

from __future__ import annotations

from dataclasses import dataclass

from cavbench.attacks.detection.eot import EOT, Loss
from cavbench.core.ranges import Count, NotNegative


@dataclass(frozen=True, kw_only=True)
class ProjectedLight(EOT):
    """Light on the sign, as of a projector (SLAP, Lovisotto et al. 2021, arXiv 2007.04137): it adds, and takes nothing away.

    `eot` with other defaults, under `threat.shape=light`. The budget bounds the added light as a share of the light on the sign.

    Args:
        loss: what is minimised: the mean of the score, or of its log-odds (default log_odds).
        tv: weight of the total variation (default 0.05).
        window: side in pixels of the square window around the sign (default 160).

    The other parameters are those of `eot`.

    Queries: restarts * steps * batch images.

    Example:
        >>> from cavbench.attacks.detection.projected import ProjectedLight
        >>> coarse = ProjectedLight(texels=25)
    """

    loss: Loss = "log_odds"
    tv: NotNegative = 0.05
    window: Count = 160

    @property
    def forges(self) -> tuple[str, ...]:
        return ("shape=light",)
