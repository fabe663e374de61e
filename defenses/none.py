"""No defence: the victim as it was trained."""

from __future__ import annotations

from dataclasses import dataclass

from bench.contracts import Defense, Policy, Victim


@dataclass(frozen=True, kw_only=True)
class NoDefense(Defense):
    """Leaves the victim as it is."""

    def load(self, victim: Victim, seed: int) -> Policy:
        return victim.load(seed)
