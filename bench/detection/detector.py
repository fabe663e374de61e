"""Object detectors: images to boxes with scores, differentiable in the pixels.

A box is [x1, y1, x2, y2] in pixels of the image: x to the right, y down, from the outer corner of the first pixel.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor, nn

from cavbench.core.registry import unknown
from cavbench.errors import UserError


@dataclass(frozen=True)
class Predictions:
    """All predictions of a detector on N images, before any filtering, with the graph back to the pixels.

    Args:
        boxes: [N, K, 4] in pixels; they may extend beyond the image.
        objectness: [N, K] in [0, 1], the probability that there is an object.
        classes: [N, K, C] in [0, 1], the probability of each class given an object; they need not sum to 1.
    """

    boxes: Tensor
    objectness: Tensor
    classes: Tensor

    @property
    def scores(self) -> Tensor:
        """[N, K, C] in [0, 1]: objectness times class probability (Redmon et al. 2016, Eq. 1)."""
        return self.objectness.unsqueeze(-1) * self.classes

    def scores_of(self, label: int) -> Tensor:
        """[N, K] the scores of one class, without computing the other classes."""
        return self.objectness * self.classes[..., label]


STOP_SIGN = "stop sign"
"""The class to hide, as detectors name it."""


@dataclass(frozen=True)
class Objects:
    """The true objects in an image: boxes [K, 4] in pixels, and the class name of each."""

    boxes: Tensor
    names: tuple[str, ...]


@dataclass(frozen=True)
class Detections:
    """The objects detected in one image, best first: boxes [M, 4] in pixels, scores [M] in [0, 1], labels int64 [M]."""

    boxes: Tensor
    scores: Tensor
    labels: Tensor


class Detector(nn.Module, ABC):
    """An object detector; the images of a batch do not influence each other.

    A detector with a memory reports more than it sees in one image: what `advance` makes of the predictions on the frames of an
    approach. What it remembers is a value (`initial`), never an attribute.
    """

    names: tuple[str, ...]
    """Class names, by label."""
    stride: int
    """Height and width of an image must be multiples of it."""
    weights_sha256: str = ""
    """Hash of the detector's weights file; empty if there is none."""
    aligned: bool = True
    """Whether the predictions with the same number are of the same place in every image of a size."""
    half_precision: ClassVar[bool] = True
    """Whether the zoo stores its kernels in half precision."""

    @abstractmethod
    def predict(self, pictures: Tensor) -> Predictions:
        """`forward` for images that have a valid shape."""

    def forward(self, pictures: Tensor) -> Predictions:
        """All predictions for a batch of images.

        Args:
            pictures: float [N, 3, H, W], sRGB in [0, 1], H and W multiples of `stride`.

        Raises:
            ValueError: if the shape is wrong.
        """
        if pictures.ndim != 4 or pictures.shape[1] != 3 or any(side % self.stride for side in pictures.shape[2:]):
            wanted = f"[N, 3, H, W] with H and W multiples of {self.stride}"
            raise ValueError(f"pictures must be {wanted}, got {list(pictures.shape)}")
        return self.predict(pictures)

    @property
    def remembers(self) -> bool:
        """Whether what it reports on a frame may depend on the frames before: it, or one that it is made of, has an `advance`."""
        plain = (Detector.advance, Wrapped.advance)
        parts = (part for part in self.modules() if isinstance(part, Detector))
        return any(getattr(part.advance, "__func__", None) not in plain for part in parts)

    def initial(self) -> Any:
        """What is remembered before the first frame of an approach; None for a detector without a memory."""
        return None

    def advance(self, predictions: Predictions, moved_m: Tensor, state: Any) -> tuple[Predictions, Any]:
        """What is reported on the next F frames of an approach, and what is remembered after them; without side effects.

        Args:
            predictions: those of `forward` on the F frames, in driving order.
            moved_m: [F] distance that the car has driven since the frame before, in m; 0 at the first.
            state: what is remembered before them.
        """
        return predictions, state

    def aggregate(self, scores: Tensor) -> Tensor:
        """[..., F] the scores that `advance` reports on one object; attacks optimise these, so they need a gradient.

        Args:
            scores: [..., F] score of the object in each frame by itself, in driving order.
        """
        return scores

    def certified(self, pictures: Tensor, boxes: Tensor, reach: Tensor) -> Tensor | None:
        """A lower bound of what is reported on a stop sign, whatever a patch shows; None for a detector without a certificate.

        It bounds the confidence (`cavbench.detection.boxes.confidence`), which is taken before non-maximum suppression.

        Args:
            pictures: float [N, 3, H, W], images without a patch, sRGB in [0, 1].
            boxes: [N, 4], the true box of the sign in each.
            reach: [N, 4], a box in each; pixels outside of it are not changed.

        Returns:
            [N] in [0, 1]; 0 where nothing is certain.
        """
        return None

    def index(self, name: str) -> int:
        """The label of a class.

        Raises:
            UserError: if the detector does not have this class.
        """
        return label_of(name, self.names)


class Wrapped(Detector):
    """A detector around another one, with its classes and its memory, but without its certificate.

    Args:
        inner: the other one.
    """

    def __init__(self, inner: Detector) -> None:
        super().__init__()
        self.inner = inner
        self.names, self.stride, self.weights_sha256 = inner.names, inner.stride, inner.weights_sha256
        self.aligned = inner.aligned

    def initial(self) -> Any:
        return self.inner.initial()

    def advance(self, predictions: Predictions, moved_m: Tensor, state: Any) -> tuple[Predictions, Any]:
        return self.inner.advance(predictions, moved_m, state)

    def aggregate(self, scores: Tensor) -> Tensor:
        return self.inner.aggregate(scores)


def label_of(name: str, names: Sequence[str]) -> int:
    """The label of a class of a detector.

    Raises:
        UserError: if there is no such class.
    """
    if name not in names:
        raise UserError(unknown(f"class {name!r}", name, names))
    return names.index(name)
