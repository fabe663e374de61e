"""String stability: whether a car passes less acceleration on than the car ahead had."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

SETTLED_S = 20.0
"""Accelerations count from this moment on: before it a controller takes its own distance."""
KEYS = ("time_gap", "acceleration", "acceleration_ahead")
"""What a world says in `info`, if it can."""


class Strings:
    """The smallest time gap of B episodes, and what the driven car makes of the accelerations of the car ahead.

    Its amplification is the ratio of the two signals' norms (Ploeg, van de Wouw and Nijmeijer 2014, strict string stability): L2,
    and L-infinity for the peak.

    Args:
        batch: B.
        period: seconds per decision.
    """

    def __init__(self, batch: int, period: float) -> None:
        self.settled, self.elapsed = round(SETTLED_S / period), 0
        self.gap = np.full(batch, np.nan)
        self.squares, self.peaks = np.zeros((2, batch)), np.zeros((2, batch))

    def step(self, info: Mapping[str, NDArray[np.generic]], running: NDArray[np.bool_]) -> None:
        """Count one step of the `running` episodes, bool [B]."""
        self.elapsed += 1
        if "time_gap" not in info:
            return
        np.fmin(self.gap, info["time_gap"].astype(np.float64), out=self.gap, where=running)
        if self.elapsed <= self.settled:
            return
        felt = np.where(running, np.stack([info["acceleration"], info["acceleration_ahead"]]).astype(np.float64), 0.0)
        self.squares += felt**2
        np.maximum(self.peaks, np.abs(felt), out=self.peaks)

    def columns(self) -> dict[str, NDArray[np.generic]]:
        """One value an episode; NaN in a world that does not say, and where the car ahead kept its speed."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return {
                "min_time_gap_s": self.gap,
                "amplification": np.where(self.squares[1] > 0, np.sqrt(self.squares[0] / self.squares[1]), np.nan),
                "amplification_peak": np.where(self.peaks[1] > 0, self.peaks[0] / self.peaks[1], np.nan),
            }
