"""Input transformations for detectors, which remove fine detail that a patch may need."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from cavbench.core.contracts import Facts
from cavbench.detection import Detector, DetectorDefense, DetectorVictim, Predictions, Wrapped


class Guarded(Wrapped):
    """A detector with an input transformation.

    The gradient of the transformation is the identity (BPDA, Athalye et al. 2018, "Obfuscated gradients give a false sense of
    security"), so that adaptive attacks are possible.
    """

    def predict(self, pictures: Tensor) -> Predictions:
        with torch.no_grad():
            change = self.transform(pictures) - pictures
        return self.inner.predict(pictures + change)

    @abstractmethod
    def transform(self, pictures: Tensor) -> Tensor:
        """Transform images [N, 3, H, W] in [0, 1]."""


class _Median(Guarded):
    def __init__(self, inner: Detector, size: int) -> None:
        super().__init__(inner)
        self.size = size

    def transform(self, pictures: Tensor) -> Tensor:
        from kornia.filters import median_blur

        return median_blur(pictures, self.size)


@dataclass(frozen=True, kw_only=True)
class MedianSmoothing(DetectorDefense):
    """A median filter on each colour channel of the detector's input (Xu et al. 2018, "Feature squeezing", section 4.2).

    Args:
        size: side of the neighbourhood in pixels, odd, from 3 to 11 (default 3).
    """

    size: Literal[3, 5, 7, 9, 11] = 3

    def load(self, victim: DetectorVictim, seed: int, facts: Facts) -> Detector:
        return _Median(victim.load(seed, facts), self.size).eval()
