"""A patch from a file: one that was printed and scanned, or made elsewhere."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from cavbench.core.contracts import Access, Progress
from cavbench.detection import PatchAttack, PatchOracle, Scenes
from cavbench.detection.scanned import opened
from cavbench.detection.threat import SIDES
from cavbench.errors import UserError


@dataclass(frozen=True, kw_only=True)
class GivenPatch(PatchAttack):
    """The texels of a square picture, one pixel each, such as `bench patch scan` writes.

    Args:
        path: of the picture (PNG, JPEG, TIFF, BMP or WebP), with sides from 8 to 512 pixels.
        sha256: of its pixels; filled in, so that records name what was shown. Another one is refused.
    """

    access: ClassVar[Access] = "oblivious"
    seeded: ClassVar[bool] = False

    path: str = ""
    sha256: str = ""

    def __post_init__(self) -> None:
        if not self.path:
            return
        try:
            found = hashlib.sha256(self._texels().numpy().tobytes()).hexdigest()
        except UserError as error:
            raise ValueError(str(error)) from None
        if self.sha256 not in ("", found):
            raise ValueError(
                f"{self.path} has other pixels than attack.sha256={self.sha256[:12]} says: it has {found[:12]}"
            )
        object.__setattr__(self, "sha256", found)

    def _texels(self) -> Tensor:
        """The texels [3, P, P], sRGB in [0, 1].

        Raises:
            UserError: if the picture cannot be read, or is not square, or too small or large.
        """
        picture = opened(Path(self.path).expanduser())
        height, width, _ = picture.shape
        if height != width or height not in SIDES:
            raise UserError(
                f"{self.path} has {width} x {height} pixels: a patch is square, with {SIDES[0]} to {SIDES[-1]}"
            )
        return torch.from_numpy(picture.copy()).permute(2, 0, 1).float() / 255

    def lacks(self, world: object) -> str:
        return "" if self.path else "give attack.path=PICTURE, such as `bench patch scan` writes"

    def craft(self, oracle: PatchOracle, scenes: Scenes, progress: Progress) -> Tensor:
        return self._texels()
