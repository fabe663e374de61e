"""The training data of detectors: square windows of training scenes, with random places, sizes and light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from cavbench.detection import Scenes

BATCH = 16
"""Frames per rendering call."""
LEAST_INSIDE = 0.4
"""Smallest share of an object's box that must be inside a window for the object to be a target."""


@dataclass(frozen=True)
class Views:
    """N windows: frame [N], corner [N, 2] and side [N] of each, in pixels of the frame."""

    frames: Tensor
    corners: Tensor
    sides: Tensor

    def __getitem__(self, which: Tensor) -> Views:
        return Views(self.frames[which], self.corners[which], self.sides[which])

    def boxes(self, boxes: Tensor, side: int) -> Tensor:
        """One box [N, 4] of each frame, converted to pixels of its window, scaled to `side`."""
        return (boxes - self.corners.repeat(1, 2)) * (side / self.sides)[:, None]


class Windows:
    """Draws random windows of scenes.

    The images are rendered once and stored with 8 bits: 1.4 MB for an image of 1248 x 384.

    Args:
        scenes: the frames.
        side: side of the returned windows, in pixels.
        zoom: smallest and largest side of the window in the image, as multiples of `side`.
        away: share of the windows at uniformly random places; the others are near the sign.
        generator: random generator.
    """

    def __init__(
        self,
        scenes: Scenes,
        side: int,
        *,
        zoom: tuple[float, float] = (1.0, 1.0),
        away: float,
        generator: torch.Generator,
    ) -> None:
        self.scenes, self.side, self.zoom, self.away, self.generator = scenes, side, zoom, away, generator
        self.pictures = kept(scenes, lambda frames: scenes.render(frames, None, 1.0))
        self._objects = cache(scenes.objects)

    def draw(self, count: int) -> Views:
        """Draw `count` windows of random frames."""
        frames = torch.randint(len(self.scenes), (count,), generator=self.generator)
        height, width = self.scenes.size
        low, high = self.zoom
        largest = torch.tensor(min(height, width, self.side * high))
        sides = (self.side * low * (high / low) ** self._uniform(count)).minimum(largest).round()
        box = self.scenes.boxes[frames]
        near = (box[:, :2] + box[:, 2:]) / 2 + (self._uniform(count, 2) - 0.5) * 0.7 * sides[:, None]
        far = self._uniform(count, 2) * torch.tensor([width, height])
        middle = torch.where(self._uniform(count, 1) < self.away, far, near)
        most = torch.stack((width - sides, height - sides), 1)
        corners = (middle - sides[:, None] / 2).round().clamp(min=0).minimum(most)
        return Views(frames, corners, sides)

    def cut(self, views: Views, pictures: Tensor | None = None) -> Tensor:
        """Cut out the windows [N, 3, side, side].

        Args:
            views: places of the windows.
            pictures: images [N, 3, H, W] of their frames, or `kept` ones; None uses the frames without a patch.
        """
        windows = []
        for number, (frame, (x, y), side) in enumerate(
            zip(views.frames.tolist(), views.corners.int().tolist(), views.sides.int().tolist(), strict=True)
        ):
            picture = self.pictures[frame] if pictures is None else pictures[number]
            window = picture[:, y : y + side, x : x + side]
            window = window if window.is_floating_point() else window.float() / 255
            windows.append(window if side == self.side else _resized(window, self.side))
        return torch.stack(windows)

    def objects(self, views: Views, index: Callable[[str], int]) -> tuple[list[Tensor], list[Tensor]]:
        """The boxes [K, 4] and labels [K] of the objects in each window that are inside it by at least `LEAST_INSIDE`."""
        boxes, labels = [], []
        for frame, corner, side in zip(views.frames.tolist(), views.corners, views.sides, strict=True):
            known = self._objects(frame)
            whole = (known.boxes - corner.repeat(2)) * (self.side / side)
            inside = whole.clamp(0, self.side)
            enough = _area(inside) >= LEAST_INSIDE * _area(whole)
            boxes.append(inside[enough])
            labels.append(torch.tensor([index(name) for name in known.names])[enough])
        return boxes, labels

    def lit(self, *windows: Tensor) -> list[Tensor]:
        """Windows [N, 3, side, side] in random light (brightness, contrast, tint, noise), the same for all batches given."""
        count = len(windows[0])
        gain = 1 + 0.5 * (self._uniform(count, 1, 1, 1) - 0.5) + 0.1 * (self._uniform(count, 3, 1, 1) - 0.5)
        offset = 0.2 * (self._uniform(count, 1, 1, 1) - 0.5)
        noise = 0.02 * torch.randn(windows[0].shape, generator=self.generator)
        return [(one * gain + offset + noise).clamp(0, 1) for one in windows]

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator)


def kept(scenes: Scenes, render: Callable[[Tensor], Tensor]) -> Tensor:
    """All frames of scenes with 8 bits, uint8 [M, 3, H, W], as `render` shows them."""
    batches = torch.arange(len(scenes)).split(BATCH)
    return torch.cat([(render(frames) * 255).round().byte() for frames in batches])


def _area(boxes: Tensor) -> Tensor:
    return (boxes[:, 2:] - boxes[:, :2]).prod(-1)


def _resized(window: Tensor, side: int) -> Tensor:
    return torch.nn.functional.interpolate(window[None], (side, side), mode="bilinear", antialias=True)[0]
