"""No attack: the clean control that every table stands on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from bench.plugins.contracts import Access, Attack


@dataclass(frozen=True, kw_only=True)
class NoAttack(Attack):
    """Shows the victim the world as it is, on every track."""

    track: ClassVar[str] = "any"
    access: ClassVar[Access] = "oblivious"
