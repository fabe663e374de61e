"""No defence: the victim as it was trained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bench.contracts import Victim
from bench.driving import DrivingDefense
from bench.vision import DetectorDefense


@dataclass(frozen=True, kw_only=True)
class NoDefense(DrivingDefense, DetectorDefense):
    """Leaves the victim as it is."""

    def load(self, victim: Victim, seed: int) -> Any:
        return victim.load(seed)
