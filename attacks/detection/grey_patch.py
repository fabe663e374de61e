"""A plain grey patch: a baseline that measures the effect of covering the sign."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from cavbench.core.contracts import Access, Progress
from cavbench.core.ranges import Share
from cavbench.detection import PatchAttack, Scenes

if TYPE_CHECKING:
    from cavbench.detection import PatchOracle


@dataclass(frozen=True, kw_only=True)
class GreyPatch(PatchAttack):
    """A patch of uniform grey.

    Args:
        level: sRGB value, in [0, 1] (default 0.5).
    """

    access: ClassVar[Access] = "oblivious"
    seeded: ClassVar[bool] = False

    level: Share = 0.5

    def craft(self, oracle: PatchOracle, scenes: Scenes, progress: Progress) -> Tensor:
        return torch.full((3, 8, 8), self.level)
