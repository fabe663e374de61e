"""Input transformations before a detector: what a patch needs in fine detail does not come through."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from bench.detection import Detector, DetectorDefense, DetectorVictim, Predictions
from bench.plugins.contracts import Facts


class Guarded(Detector):
    """A detector behind a transformation of its pictures.

    The gradient goes straight through the transformation (BPDA, Athalye et al. 2018, "Obfuscated gradients give a false sense
    of security"), so that an attack that knows of it can adapt.
    """

    def __init__(self, inner: Detector) -> None:
        super().__init__()
        self.inner = inner
        self.names, self.stride, self.weights_sha256 = inner.names, inner.stride, inner.weights_sha256

    def predict(self, pictures: Tensor) -> Predictions:
        with torch.no_grad():
            lost = self.transform(pictures) - pictures
        return self.inner.predict(pictures + lost)

    @abstractmethod
    def transform(self, pictures: Tensor) -> Tensor:
        """Pictures [N, 3, H, W] in [0, 1] as the detector shall see them."""


class _Median(Guarded):
    def __init__(self, inner: Detector, size: int) -> None:
        super().__init__(inner)
        self.size = size

    def transform(self, pictures: Tensor) -> Tensor:
        from kornia.filters import median_blur

        return median_blur(pictures, self.size)


@dataclass(frozen=True, kw_only=True)
class MedianSmoothing(DetectorDefense):
    """Every pixel becomes the median of those around it (Xu et al. 2018, "Feature squeezing", section 4.2), colour by colour.

    Args:
        size: side of the neighbourhood in pixels, odd, from 3 to 11 (default 3).
    """

    size: Literal[3, 5, 7, 9, 11] = 3

    def load(self, victim: DetectorVictim, seed: int, facts: Facts) -> Detector:
        return _Median(victim.load(seed, facts), self.size).eval()
