"""Frames of a camera world; a patch can be rendered onto the sign in each frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from cavbench.detection.detector import STOP_SIGN, Objects
from cavbench.detection.mount import Mount

FAMILIES = ("words", "colours", "signs")
"""Faces that are not to be stopped for: other words on the red octagon; octagons of other colours and red plates of other shapes
with white marks; real signs."""
FOREIGN = "stops"
"""The family of the stop signs of other countries, which are to be stopped for."""


@dataclass(frozen=True)
class Decoy:
    """What stands in the place of the stop sign to see whether a detector knows the sign: another face, or none.

    Args:
        name: of the face.
        octagonal: whether it has the outline of the stop sign.
        family: one of `FAMILIES`, or `FOREIGN`; empty for neither.
    """

    name: str
    octagonal: bool
    family: str = ""


class Scenes(ABC):
    """M frames of a camera world, each with a stop sign that can carry a patch.

    A patch is [3, P, P] sRGB in [0, 1], top row first, P from 8 to 512 texels. It covers a square in the middle of the sign's
    face; the side of the square is `share` times the sign's side.
    """

    size: tuple[int, int]
    """Height and width of every frame in pixels."""
    boxes: Tensor
    """[M, 4] box of the sign in each frame, clipped to the image, in pixels."""
    visible: Tensor
    """[M] share of the sign that is in the image and not hidden, in [0, 1]."""
    distance: Tensor
    """[M] distance from the camera to the sign along the road, in m."""
    decoys: tuple[Decoy, ...] = ()
    """[M] the decoy of each frame (`render_decoys`); empty if the world has none."""
    faces: tuple[Decoy, ...] = ()
    """[M] a face of each frame that no training sees, of one of `FAMILIES` or `FOREIGN`; empty if the world has none."""
    mount: Mount = Mount()
    """How patches are shown; the square in the middle of the sign unless the scenes come from `mounted`."""

    def __len__(self) -> int:
        return len(self.boxes)

    def apart(self) -> Scenes:
        """The same frames for foreign code: what it writes to the boxes or to what these scenes cache does not reach these."""
        other = copy(self)
        for name, value in vars(other).items():
            if isinstance(value, Tensor):
                setattr(other, name, value.clone())
            elif isinstance(value, dict | list):
                setattr(other, name, copy(value))
        return other

    def mounted(self, mount: Mount) -> Scenes:
        """The same frames, with patches shown in this way. A world whose `mounts` is true overrides it."""
        if mount != self.mount:
            raise NotImplementedError(f"{type(self).__name__} shows patches as squares in the middle of the sign alone")
        return self

    def objects(self, frame: int) -> Objects:
        """The objects in a frame, as training targets: the sign, unless a world overrides it."""
        return Objects(self.boxes[frame : frame + 1], (STOP_SIGN,))

    @abstractmethod
    def render(self, frames: Tensor, patches: Tensor | None, share: float) -> Tensor:
        """Images [N, 3, H, W] sRGB in [0, 1], differentiable in the patches.

        Args:
            frames: int64 [N], indices of the frames.
            patches: [N, 3, P, P], or [1, 3, P, P] for the same patch in all frames; None for no patch.
            share: side of the patch as a share of the sign's side, in (0, 1].
        """

    def render_decoys(self, frames: Tensor) -> Tensor:
        """Images [N, 3, H, W] as those of `render`, but with the frame's decoy in the place of the stop sign.

        Args:
            frames: int64 [N], indices of the frames.
        """
        raise NotImplementedError(f"{type(self).__name__} has no decoys")

    def redrawn(self, number: int, like_signs: bool = False) -> Scenes:
        """The same frames for training with other decoys, those of a number; the same decoys unless a world overrides it.

        Args:
            number: of the decoys.
            like_signs: with other words on the octagon, real signs, and foreign stop signs among them (`Decoy.family`).
        """
        return self

    def with_decoys(self, decoys: Sequence[Decoy]) -> Scenes:
        """The same frames with these decoys, one for each frame."""
        raise NotImplementedError(f"{type(self).__name__} has no other decoys")

    def windows(
        self, frames: Tensor, patches: Tensor | None, share: float, corners: Tensor, size: tuple[int, int]
    ) -> Tensor:
        """Windows [N, 3, h, w] of the images of `render`; a world may override this to render only the windows, which is faster.

        Args:
            frames, patches, share: as in `render`.
            corners: int64 [N, 2], column and row of the first pixel of each window.
            size: height and width; every window lies within its image.
        """
        height, width = size
        pictures = self.render(frames, patches, share)
        cut = [p[:, y : y + height, x : x + width] for p, (x, y) in zip(pictures, corners.tolist(), strict=True)]
        return torch.stack(cut)

    def reach(self, share: float) -> Tensor:
        """[M, 4] boxes around all pixels that a patch changes: the sign's boxes, unless a world overrides it."""
        return self.boxes


@dataclass(frozen=True)
class Approach:
    """A drive up to one stop sign.

    Args:
        seed: scenario seed.
        location: name of the place.
        scenes: its frames in driving order, farthest first.
    """

    seed: int
    location: str
    scenes: Scenes
