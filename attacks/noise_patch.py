"""A patch of random colours: the control that every crafted patch is held against."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from bench.detection import PatchAttack, PatchOracle, Scenes
from bench.detection.threat import Texels
from bench.plugins.contracts import Access, Progress


@dataclass(frozen=True, kw_only=True)
class NoisePatch(PatchAttack):
    """Texels drawn uniformly from all colours: how much of a patch's effect is that it covers the sign.

    Args:
        texels: side of the patch in texels, from 8 to 512 (default 100).
    """

    access: ClassVar[Access] = "oblivious"

    texels: Texels = 100

    def craft(self, oracle: PatchOracle, scenes: Scenes, progress: Progress) -> Tensor:
        return torch.rand(3, self.texels, self.texels, generator=oracle.generator)
