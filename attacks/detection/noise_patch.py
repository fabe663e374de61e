"""A patch of random colours: the baseline for every crafted patch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from cavbench.core.contracts import Access, Progress
from cavbench.detection import PatchAttack, PatchOracle, Scenes
from cavbench.detection.threat import Texels


@dataclass(frozen=True, kw_only=True)
class NoisePatch(PatchAttack):
    """Uniformly random texels, to measure the effect of covering the sign.

    Args:
        texels: side of the patch in texels, from 8 to 512 (default 100).
    """

    access: ClassVar[Access] = "oblivious"

    texels: Texels = 100

    def craft(self, oracle: PatchOracle, scenes: Scenes, progress: Progress) -> Tensor:
        return torch.rand(3, self.texels, self.texels, generator=oracle.generator)
