"""Red squares that grow as the projection says, and a detector that measures them to a fraction of a pixel."""

from __future__ import annotations

import torch
from torch import Tensor

from cavbench.detection import Detector, Predictions, Scenes

HEIGHT, WIDTH = 96, 192
SIGN_PX_M = 480.0
"""Width of a sign times its distance: 60 pixels at 8 m."""


class GrowingScenes(Scenes):
    """The sign in the right half of the image, and something that looks like it in the left half.

    Args:
        distance: [F] to the sign in m, farthest first.
        seen: [F] whether the sign is shown; None for always.
        other: [F] whether the other square is shown; None for never.
        beyond_m: how far it is beyond the sign; negative before it.
    """

    size = (HEIGHT, WIDTH)

    def __init__(
        self, distance: Tensor, seen: Tensor | None = None, other: Tensor | None = None, beyond_m: float = 0.0
    ) -> None:
        self.distance = distance
        self.seen = torch.ones(len(distance)) if seen is None else seen.float()
        self.other = torch.zeros(len(distance)) if other is None else other.float()
        self.beyond_m = beyond_m
        self.boxes = torch.stack([_square(float(one), 0.75) for one in distance])
        self.visible = torch.ones(len(distance))
        self.decoys = ()

    def render(self, frames: Tensor, patches: Tensor | None, share: float) -> Tensor:
        return torch.stack(
            [self._picture(int(frame), None if patches is None else patches[0], share) for frame in frames]
        )

    def _picture(self, frame: int, patch: Tensor | None, share: float) -> Tensor:
        picture = torch.zeros(3, *self.size)
        box, red = self.boxes[frame], torch.tensor([1.0, 0.0, 0.0])
        away = float(self.distance[frame]) + self.beyond_m
        if bool(self.other[frame]) and away > SIGN_PX_M / HEIGHT:
            picture = _painted(picture, _square(away, 0.25), red)
        if bool(self.seen[frame]):
            picture = _painted(picture, box, red)
            if patch is not None:
                middle, half = (box[:2] + box[2:]) / 2, (box[2:] - box[:2]) * share / 2
                picture = _painted(picture, torch.cat([middle - half, middle + half]), patch.mean((1, 2)))
        return picture


class SquareDetector(Detector):
    """One box in each half of the image; a square that is mostly red is a stop sign."""

    names = ("stop sign",)
    stride = 1

    def predict(self, pictures: Tensor) -> Predictions:
        boxes, sure = [], []
        for picture in pictures:
            for half, left in ((picture[..., : WIDTH // 2], 0), (picture[..., WIDTH // 2 :], WIDTH // 2)):
                red = (half[0] - half[1:].mean(0)).clamp(min=0)
                (x0, x1), (y0, y1) = _ends(red.amax(0)), _ends(red.amax(1))
                boxes.append(torch.tensor([x0 + left, y0, x1 + left, y1]))
                sure.append(float(red.sum() > 0.5 * (x1 - x0) * (y1 - y0)))
        shape = (len(pictures), 2)
        return Predictions(torch.stack(boxes).view(*shape, 4), torch.tensor(sure).view(shape), torch.ones(*shape, 1))


def _square(distance: float, across: float) -> Tensor:
    """The box of a sign at a share of the image's width."""
    middle = torch.tensor([across * WIDTH, HEIGHT / 2])
    half = SIGN_PX_M / distance / 2
    return torch.cat([middle - half, middle + half])


def _painted(picture: Tensor, box: Tensor, colour: Tensor) -> Tensor:
    """A picture with a filled box; pixels at its edge are covered in part."""

    def covered(size: int, low: Tensor, high: Tensor) -> Tensor:
        pixel = torch.arange(size)
        return (torch.minimum(pixel + 1, high) - torch.maximum(pixel.float(), low)).clamp(0, 1)

    cover = covered(HEIGHT, box[1], box[3])[:, None] * covered(WIDTH, box[0], box[2])
    return picture * (1 - cover) + colour[:, None, None] * cover


def _ends(profile: Tensor) -> tuple[float, float]:
    """Where a profile begins and ends; (0, 1) if it is empty."""
    where = profile.nonzero()
    if not len(where):
        return 0.0, 1.0
    first, last = int(where[0]), int(where[-1])
    return first + 1 - float(profile[first]), last + float(profile[last])
