"""What attacks share that show their texels in another way than on a square of paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from cavbench.attacks.detection.eot import EOT, Loss
from cavbench.core.ranges import Count, NotNegative
from cavbench.detection.mount import Shape


@dataclass(frozen=True, kw_only=True)
class ShapedEOT(EOT):
    """`eot` with other defaults, under the `threat.shape` that it needs.

    Args:
        loss: what is minimised: the mean of the score, or of its log-odds (default log_odds).
        tv: weight of the total variation (default 0.05).
        window: side in pixels of the square window around the sign (default 160).
    """

    shape: ClassVar[Shape]

    loss: Loss = "log_odds"
    tv: NotNegative = 0.05
    window: Count = 160

    @property
    def forges(self) -> tuple[str, ...]:
        return (f"shape={self.shape}",)
