"""A detector on another device than the run."""

from __future__ import annotations

import torch
from torch import Tensor

from cavbench.core.device import CPU, move
from cavbench.detection.detector import Detector, Predictions, Wrapped


class Placed(Wrapped):
    """A detector on another device: images are copied there, and predictions and gradients come back to the processor.

    Args:
        detector: the (defended) victim.
        device: where it computes, for instance `cuda`.
    """

    def __init__(self, detector: Detector, device: str) -> None:
        super().__init__(detector)
        self._there = torch.device(device)
        move(detector, self._there)

    def forward(self, pictures: Tensor) -> Predictions:
        return self.predict(pictures)

    def predict(self, pictures: Tensor) -> Predictions:
        found = self.inner(pictures.to(self._there))
        return Predictions(found.boxes.to(CPU), found.objectness.to(CPU), found.classes.to(CPU))

    def certified(self, pictures: Tensor, boxes: Tensor, reach: Tensor) -> Tensor | None:
        least = self.inner.certified(*(part.to(self._there) for part in (pictures, boxes, reach)))
        return None if least is None else least.to(CPU)


def placed(detector: Detector, device: str) -> Detector:
    """The detector on a device; itself on the processor."""
    return detector if device == CPU else Placed(detector, device)
