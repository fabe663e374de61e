"""No attack: the clean control that every table stands on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from torch import Tensor

from bench.contracts import Access, Progress
from bench.driving import DrivingAttack
from bench.vision import PatchAttack, Scenes

if TYPE_CHECKING:
    from bench.patch import VisionOracle
    from bench.threat import Oracle


@dataclass(frozen=True, kw_only=True)
class NoAttack(DrivingAttack, PatchAttack):
    """Shows the victim the world as it is."""

    access: ClassVar[Access] = "oblivious"
    seeded: ClassVar[bool] = False

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        return observation

    def craft(self, oracle: VisionOracle, scenes: Scenes, progress: Progress) -> None:
        return None
