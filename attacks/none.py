"""No attack: the clean control that every table stands on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from torch import Tensor

from bench.contracts import Access, Attack

if TYPE_CHECKING:
    from bench.threat import Oracle


@dataclass(frozen=True, kw_only=True)
class NoAttack(Attack):
    """Shows the victim the world as it is."""

    access: ClassVar[Access] = "oblivious"

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        return observation
