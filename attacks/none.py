"""No attack: the clean baseline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from cavbench.core.contracts import Access, Attack


@dataclass(frozen=True, kw_only=True)
class NoAttack(Attack):
    """Leaves the victim's input unchanged, on every track."""

    track: ClassVar[str] = "any"
    access: ClassVar[Access] = "oblivious"
