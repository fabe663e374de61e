"""No attack: the clean control that every table stands on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from torch import Tensor

from bench.detection.contracts import PatchAttack, Scenes
from bench.driving.contracts import DrivingAttack
from bench.plugins.contracts import Access, Progress

if TYPE_CHECKING:
    from bench.detection.threat import VisionOracle
    from bench.driving.threat import Oracle


@dataclass(frozen=True, kw_only=True)
class NoAttack(DrivingAttack, PatchAttack):
    """Shows the victim the world as it is."""

    access: ClassVar[Access] = "oblivious"
    seeded: ClassVar[bool] = False

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        return observation

    def craft(self, oracle: VisionOracle, scenes: Scenes, progress: Progress) -> None:
        return None
