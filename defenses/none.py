"""No defence: the victim as it was trained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bench.detection.contracts import DetectorDefense
from bench.driving.contracts import DrivingDefense
from bench.plugins.contracts import Victim


@dataclass(frozen=True, kw_only=True)
class NoDefense(DrivingDefense, DetectorDefense):
    """Leaves the victim as it is."""

    def load(self, victim: Victim, seed: int) -> Any:
        return victim.load(seed)
