"""Frames of a camera world, each with a sign that a patch can be stuck on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from bench.detection.detector import STOP_SIGN, Objects


class Scenes(ABC):
    """Frames of a camera world, each with a sign that a patch can be stuck on.

    A patch is [3, P, P] sRGB in [0, 1], its first row the top, P from 8 to 512 texels; it covers a square in the middle of the
    sign's face, whose side is `share` of the sign's.
    """

    size: tuple[int, int]
    """Height and width of every frame in pixels."""
    boxes: Tensor
    """[M, 4] the sign in each frame, clipped to the picture, in pixels."""
    visible: Tensor
    """[M] share of the sign that is in the picture and not hidden, in [0, 1]."""
    distance: Tensor
    """[M] from the camera to the sign along the road, in m."""

    def __len__(self) -> int:
        return len(self.boxes)

    def objects(self, frame: int) -> Objects:
        """What a detector that is trained on a frame should find in it: the sign, unless a world knows more."""
        return Objects(self.boxes[frame : frame + 1], (STOP_SIGN,))

    @abstractmethod
    def render(self, frames: Tensor, patches: Tensor | None, share: float) -> Tensor:
        """Pictures [N, 3, H, W] sRGB in [0, 1], differentiable to the patches.

        Args:
            frames: int64 [N], which frames.
            patches: [N, 3, P, P], or [1, 3, P, P] for the same in all; None leaves the sign as it is.
            share: side of the patch in shares of the sign's, in (0, 1].
        """

    def windows(
        self, frames: Tensor, patches: Tensor | None, share: float, corners: Tensor, size: tuple[int, int]
    ) -> Tensor:
        """Parts [N, 3, h, w] of the pictures that `render` gives; a world that renders no more than these is faster.

        Args:
            frames, patches, share: as of `render`.
            corners: int64 [N, 2], column and row of the first pixel of each.
            size: height and width; every window is within its picture.
        """
        height, width = size
        pictures = self.render(frames, patches, share)
        cut = [p[:, y : y + height, x : x + width] for p, (x, y) in zip(pictures, corners.tolist(), strict=True)]
        return torch.stack(cut)

    def reach(self, share: float) -> Tensor:
        """[M, 4] boxes around all that a patch changes: the sign's, unless a world knows a smaller or needs a larger one."""
        return self.boxes


@dataclass(frozen=True)
class Approach:
    """A drive up to one stop sign, the sign's face as it is until a patch is rendered onto it.

    Args:
        seed: scenario seed.
        location: name of the place.
        scenes: its frames, farthest first, in the order they are driven through.
    """

    seed: int
    location: str
    scenes: Scenes
