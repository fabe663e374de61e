"""A detector whose network comes from a file: images are fitted to its input, and its boxes to the images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from cavbench.detection import Detector, Predictions
from cavbench.detection.victims.layout import CORNERS, Activation, Layout, allowed, layout_of, split
from cavbench.errors import UserError
from cavbench.formats.trial import RefusedError, failure

Boxes = Literal["auto", "corners", "corners_yx", "centre"]
Scaling = Literal["unit", "byte", "imagenet"]
Order = Literal["rgb", "bgr"]
STRIDE = 32
"""Images for a file that takes any size are multiples of it; common detectors need that."""
GREY = 114 / 255
"""The border around an image in a larger input, as in YOLO."""
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of the images of ImageNet, as in torchvision."""
MOST_BOXES = 200_000
"""Most predictions for an image."""


@dataclass(frozen=True)
class Input:
    """What the network takes.

    Args:
        batch: number of images; None for any.
        size: height and width in pixels; None for any.
        dtype: its type.
        frame: longer side in pixels of an image that fills an input of a fixed size.
        scaling: values of the pixels: in [0, 1]; in [0, 255]; or [0, 1] minus the mean of ImageNet, over its deviation.
        order: of the channels.
        channels_last: whether it takes [N, H, W, 3].
    """

    batch: int | None
    size: tuple[int, int] | None
    dtype: torch.dtype
    frame: int
    scaling: Scaling
    order: Order
    channels_last: bool = False


@dataclass(frozen=True)
class Output:
    """How the network writes boxes and scores.

    Args:
        boxes: `corners` [x1, y1, x2, y2], `corners_yx` [y1, x1, y2, x2], `centre` [x, y, width, height]; `auto`: as is usual in
            the layout of the outputs.
        normalised: whether they are shares of the input's width and height.
        activation: makes probabilities of its scores.
    """

    boxes: Boxes
    normalised: bool
    activation: Activation = "none"


class FileDetector(Detector):
    """A detector from a file, or a network of the caller.

    Args:
        network: maps images [N, 3, h, w] to outputs (`cavbench.detection.victims.layout`).
        path: the file in errors.
        names: class names, by label.
        given: what the network takes.
        made: how it writes boxes.
        sha256: hash of the file.
    """

    def __init__(
        self,
        network: Callable[[Tensor], Sequence[Tensor]],
        path: str,
        names: tuple[str, ...],
        given: Input,
        made: Output,
        sha256: str,
    ) -> None:
        super().__init__()
        self.network, self.path, self.names = network, path, names
        self.given, self.made, self.weights_sha256 = given, made, sha256
        self.stride = 1 if given.size else STRIDE
        self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> FileDetector:
        """Stay in eval mode: an exported network has only the mode in which it was exported."""
        self.training = False
        return self

    def predict(self, pictures: Tensor) -> Predictions:
        """All predictions for images [N, 3, H, W].

        Raises:
            UserError: if the file fails, or returns other outputs than are allowed.
        """
        boxes, objectness, classes, shift, scale = self.raw(pictures)
        return Predictions((boxes - shift) / scale, objectness.clamp(0, 1), classes.clamp(0, 1))

    def raw(self, pictures: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Boxes [N, K, 4] in pixels of the input, objectness and classes as in the file, and where in the input the images are.

        The last two are the shift [4] in pixels of the input, and the scale [4].
        """
        shown, shift, scale = self._fitted(pictures)
        outputs = self._answers(self._scaled(shown))
        layout = layout_of([tuple(one.shape) for one in outputs], len(self.names))
        if layout is None or any(len(one) != len(pictures) for one in outputs):
            found = " and ".join(str(list(one.shape)) for one in outputs[:4]) or "nothing"
            raise UserError(
                f"{self.path} returns {found} for {_images(len(pictures))}; with {len(self.names)} classes (victim.names) "
                f"it must return {allowed(len(self.names))}"
            )
        whole = [one.float() if one.is_floating_point() else one for one in outputs]
        try:
            boxes, objectness, classes = split(whole, layout, len(self.names), self.made.activation)
        except UserError as error:
            raise UserError(f"{self.path} cannot be read: {error}") from None
        if not 0 < boxes.shape[1] <= MOST_BOXES:
            raise UserError(
                f"{self.path} returns {boxes.shape[1]} boxes for an image; from 1 to {MOST_BOXES} are allowed, "
                "all of them before non-maximum suppression"
            )
        if self.made.boxes == "corners_yx" or (self.made.boxes == "auto" and layout == "counted"):
            boxes = boxes[..., [1, 0, 3, 2]]
        if self.made.normalised:
            boxes = boxes * boxes.new_tensor([shown.shape[3], shown.shape[2]] * 2)
        return self._corners(boxes, layout), objectness, classes, shift, scale

    def _corners(self, boxes: Tensor, layout: Layout) -> Tensor:
        if self.made.boxes in ("corners", "corners_yx") or (self.made.boxes == "auto" and layout in CORNERS):
            return boxes
        centre, half = boxes[..., :2], boxes[..., 2:] / 2
        return torch.cat((centre - half, centre + half), -1)

    def _fitted(self, pictures: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The images in the middle of the input, with the shift [4] and the scale [4] of the boxes in it."""
        height, width = pictures.shape[2:]
        if self.given.size is None:
            return pictures, pictures.new_zeros(4), pictures.new_ones(4)
        rows, columns = self.given.size
        # A window of an image is shown at the scale of the whole image.
        scale = min(max(rows, columns) / self.given.frame, rows / height, columns / width)
        size = max(1, round(height * scale)), max(1, round(width * scale))
        resized = pictures
        if size != (height, width):
            resized = nn.functional.interpolate(pictures, size, mode="bilinear", antialias=True)
        top, left = (rows - size[0]) // 2, (columns - size[1]) // 2
        border = (left, columns - size[1] - left, top, rows - size[0] - top)
        scales = pictures.new_tensor([size[1] / width, size[0] / height] * 2)
        return nn.functional.pad(resized, border, value=GREY), pictures.new_tensor([left, top] * 2), scales

    def outputs_for(self, pictures: Tensor) -> Sequence[Tensor]:
        """The outputs of the network for images [N, 3, H, W], as they are.

        Raises:
            UserError: if it fails.
        """
        return self._answers(self._scaled(self._fitted(pictures)[0]))

    def _scaled(self, pictures: Tensor) -> Tensor:
        if self.given.dtype == torch.uint8:
            # Whole numbers are 0 to 255 in any case.
            pictures = (pictures * 255).round().clamp(0, 255)
        elif self.given.scaling == "byte":
            pictures = pictures * 255
        elif self.given.scaling == "imagenet":
            mean, deviation = (pictures.new_tensor(one)[:, None, None] for one in (MEAN, DEVIATION))
            pictures = (pictures - mean) / deviation
        pictures = (pictures.flip(1) if self.given.order == "bgr" else pictures).to(self.given.dtype)
        return pictures.permute(0, 2, 3, 1) if self.given.channels_last else pictures

    def _answers(self, shown: Tensor) -> Sequence[Tensor]:
        """The outputs of the network; in parts if its batch size is fixed."""
        try:
            if self.given.batch is None:
                return self.network(shown)
            size, count = self.given.batch, len(shown)
            whole = torch.cat((shown, shown[-1:].expand(-count % size, -1, -1, -1)))
            parts = [self.network(part) for part in whole.split(size)]
            return [torch.cat(outputs)[:count] for outputs in zip(*parts, strict=True)]
        except RefusedError as error:
            raise UserError(f"{self.path} is refused: {error}") from error
        # A network of a stranger, and the library that runs it, can raise anything.
        except Exception as error:
            sides = " x ".join(map(str, shown.shape[1:3] if self.given.channels_last else shown.shape[2:]))
            raise UserError(f"{self.path} fails on {_images(len(shown))} of {sides}: {failure(error)} fails") from error


def _images(count: int) -> str:
    return "1 image" if count == 1 else f"{count} images"
