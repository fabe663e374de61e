"""A median filter in front of a detector, which removes fine detail that a patch may need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from cavbench.detection import ImageFilter


@dataclass(frozen=True, kw_only=True)
class MedianSmoothing(ImageFilter):
    """A median filter on each colour channel of the detector's input (Xu et al. 2018, "Feature squeezing", section 4.2).

    Args:
        size: side of the neighbourhood in pixels, odd, from 3 to 11 (default 3).
    """

    size: Literal[3, 5, 7, 9, 11] = 3

    def filter(self, pictures: Tensor) -> Tensor:
        from kornia.filters import median_blur

        return median_blur(pictures, self.size)
