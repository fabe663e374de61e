"""A driver with a memory: it confirms the sign over several frames, reacts, and brakes to stop at the line.

The closed-loop form of `cavbench.detection.stopping`, with the same constants.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cavbench.detection import stopping

NEAREST_M = 1e-3
"""The driver plans for at least this distance, so that it asks for a finite deceleration at and beyond the line."""
MOMENT_S = 1e-4
"""Times that differ by less are the same; sums of steps are rounded."""


@dataclass(frozen=True)
class Memory:
    """What the drivers of B cars remember.

    Args:
        detected: bool [B, 5], whether the sign was detected in the last frames, oldest first.
        frame: int64 [B], the last frame; a frame that is shown twice counts once.
        confirmed_m: float [B], distance in m at which the sign was confirmed; 0 until then.
        since_s: float [B], time since then.
        braking: bool [B], whether the driver has begun to brake.
    """

    detected: Tensor
    frame: Tensor
    confirmed_m: Tensor
    since_s: Tensor
    braking: Tensor

    @classmethod
    def initial(cls, batch: int) -> Memory:
        """The memory of drivers who have seen nothing."""
        none = torch.zeros(batch)
        detected = torch.zeros(batch, stopping.OF_THE_LAST, dtype=torch.bool)
        return cls(detected, torch.full((batch,), -1), none, none.clone(), torch.zeros(batch, dtype=torch.bool))

    def seeing(self, confidence: Tensor, frame: Tensor, distance: Tensor) -> Memory:
        """The memory after a look.

        Args:
            confidence: [B], confidence in the sign, in [0, 1].
            frame: int64 [B], number of the frame that is seen.
            distance: [B], distance to the line in m.
        """
        new = frame != self.frame
        seen = torch.cat([self.detected[:, 1:], (confidence > stopping.THRESHOLD)[:, None]], 1)
        detected = torch.where(new[:, None], seen, self.detected)
        confirms = (detected.sum(1) >= stopping.CONFIRMED_IN) & (self.confirmed_m <= 0) & (distance > 0)
        return replace(
            self, detected=detected, frame=frame, confirmed_m=torch.where(confirms, distance, self.confirmed_m)
        )

    def deciding(self, distance: Tensor, speed: Tensor) -> tuple[Tensor, Memory]:
        """The deceleration [B] in m/s2 that the drivers ask for, and their memory with that decision.

        After the reaction time, a driver begins to brake when it must brake comfortably or harder to stop at the line. From then
        on it asks for the deceleration that stops the car at the line, at least a comfortable one. The brakes limit it.

        Args:
            distance: [B], to the line in m.
            speed: [B] in m/s.
        """
        needed = speed.square() / (2 * distance.clamp(min=NEAREST_M))
        least = stopping.COMFORTABLE_DECELERATION
        ready = (self.confirmed_m > 0) & (self.since_s >= stopping.REACTION_S - MOMENT_S)
        braking = self.braking | (ready & (needed >= least))
        return torch.where(braking, needed.clamp(min=least), 0.0), replace(self, braking=braking)

    def after(self, seconds: float) -> Memory:
        """The memory some time later."""
        return replace(self, since_s=self.since_s + seconds * (self.confirmed_m > 0))
