"""No defence: the unchanged victim."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from cavbench.core.contracts import Defense, Facts, Victim


@dataclass(frozen=True, kw_only=True)
class NoDefense(Defense):
    """Leaves the victim unchanged, on every track."""

    track: ClassVar[str] = "any"

    def load(self, victim: Victim, seed: int, facts: Facts) -> Any:
        return victim.load(seed, facts)
