"""A detector: pictures to boxes with scores, differentiable to the pixel.

A box is [x1, y1, x2, y2] in pixels of the picture given: x to the right, y down, from the outer corner of the first pixel.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn

from bench.errors import UserError
from bench.plugins.registry import unknown


@dataclass(frozen=True)
class Predictions:
    """Everything a detector says of N pictures before anything is thrown away, with the graph back to the pixels.

    Args:
        boxes: [N, K, 4] in pixels; they may reach beyond the picture.
        objectness: [N, K] in [0, 1], the probability that there is an object at all.
        classes: [N, K, C] in [0, 1], the probability of each class if there is one; they need not sum to 1.
    """

    boxes: Tensor
    objectness: Tensor
    classes: Tensor

    @property
    def scores(self) -> Tensor:
        """[N, K, C] in [0, 1]: objectness times class probability (Redmon et al. 2016, Eq. 1)."""
        return self.objectness.unsqueeze(-1) * self.classes

    def scores_of(self, label: int) -> Tensor:
        """[N, K] the scores of one class, without those of the others."""
        return self.objectness * self.classes[..., label]


STOP_SIGN = "stop sign"
"""The class to hide, as detectors name it."""


@dataclass(frozen=True)
class Objects:
    """What there is to find in a picture: boxes [K, 4] in pixels, and the name of the class of each."""

    boxes: Tensor
    names: tuple[str, ...]


@dataclass(frozen=True)
class Detections:
    """The objects found in one picture, best first: boxes [M, 4] in pixels, scores [M] in [0, 1], labels int64 [M]."""

    boxes: Tensor
    scores: Tensor
    labels: Tensor


class Detector(nn.Module, ABC):
    """An object detector whose every picture of a batch is looked at by itself."""

    names: tuple[str, ...]
    """Of the classes, by label."""
    stride: int
    """Height and width of a picture must be multiples of it."""
    weights_sha256: str = ""
    """Hash of the weights file it was loaded from; empty where there is none."""
    half_precision: ClassVar[bool] = True
    """Whether the zoo stores its kernels in half precision."""

    @abstractmethod
    def predict(self, pictures: Tensor) -> Predictions:
        """What `forward` returns, for pictures whose shape is right."""

    def forward(self, pictures: Tensor) -> Predictions:
        """All predictions for a batch of pictures.

        Args:
            pictures: float [N, 3, H, W], sRGB in [0, 1], H and W multiples of `stride`.

        Raises:
            ValueError: if the shape is another.
        """
        if pictures.ndim != 4 or pictures.shape[1] != 3 or any(side % self.stride for side in pictures.shape[2:]):
            wanted = f"[N, 3, H, W] with H and W multiples of {self.stride}"
            raise ValueError(f"pictures must be {wanted}, got {list(pictures.shape)}")
        return self.predict(pictures)

    def index(self, name: str) -> int:
        """The label of a class.

        Raises:
            UserError: if the detector knows no such class.
        """
        if name not in self.names:
            raise UserError(unknown(f"class {name!r}", name, self.names))
        return self.names.index(name)
