"""Stickers: four small patches on the sign that hide it together."""

from __future__ import annotations

from dataclasses import dataclass

from cavbench.attacks.detection.eot import EOT, Loss
from cavbench.core.ranges import Count, NotNegative


@dataclass(frozen=True, kw_only=True)
class Stickers(EOT):
    """Robust physical perturbations (Eykholt et al. 2018, arXiv 1707.08945): stickers above and below the word.

    `eot` with other defaults, under `threat.shape=stickers`: four squares that together cover as much as the one of the same
    budget. As there, the non-printability score is a part of the loss.

    Args:
        loss: what is minimised: the mean of the score, or of its log-odds (default log_odds).
        tv: weight of the total variation (default 0.05).
        nps: weight of the non-printability score (default 0.1).
        window: side in pixels of the square window around the sign (default 160).

    The other parameters are those of `eot`.

    Queries: restarts * steps * batch images.

    Example:
        >>> from cavbench.attacks.detection.stickers import Stickers
        >>> any_colour = Stickers(nps=0)
    """

    loss: Loss = "log_odds"
    tv: NotNegative = 0.05
    nps: NotNegative = 0.1
    window: Count = 160

    @property
    def forges(self) -> tuple[str, ...]:
        return ("shape=stickers",)
