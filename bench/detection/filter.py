"""The commonest defence of a detector: a filter between the image and the detector."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import torch
from torch import Tensor

from cavbench.core.contracts import Facts
from cavbench.detection.contracts import DetectorDefense, DetectorVictim
from cavbench.detection.detector import Detector, Predictions, Wrapped


class ImageFilter(DetectorDefense):
    """Changes each image before the detector sees it. A subclass writes `filter`."""

    differentiable: ClassVar[bool] = False
    """Whether it has a useful gradient. If not, the gradient passes straight through, as if the filter added a constant
    (BPDA, Athalye et al. 2018, "Obfuscated gradients give a false sense of security"), so that adaptive attacks are possible."""

    @abstractmethod
    def filter(self, pictures: Tensor) -> Tensor:
        """What the detector sees instead of images [N, 3, H, W], sRGB in [0, 1]; the images do not influence each other."""

    def load(self, victim: DetectorVictim, seed: int, facts: Facts) -> Detector:
        return FilteredDetector(victim.load(seed, facts), self).eval()


class FilteredDetector(Wrapped):
    """A detector behind a filter.

    Args:
        inner: the detector.
        defense: the filter.
    """

    def __init__(self, inner: Detector, defense: ImageFilter) -> None:
        super().__init__(inner)
        self.defense = defense

    def predict(self, pictures: Tensor) -> Predictions:
        if self.defense.differentiable:
            return self.inner.predict(self._filtered(pictures))
        with torch.no_grad():
            change = self._filtered(pictures) - pictures
        return self.inner.predict(pictures + change)

    def _filtered(self, pictures: Tensor) -> Tensor:
        seen = self.defense.filter(pictures)
        # A sum would repeat a smaller answer, and the detector would see something else than the filter meant.
        if getattr(seen, "shape", None) != pictures.shape:
            name, shape = type(self.defense).__name__, tuple(pictures.shape)
            raise ValueError(f"the filter {name} must answer images {shape} with a tensor of that shape")
        return seen
