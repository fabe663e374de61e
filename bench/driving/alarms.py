"""What a victim says about being attacked: the measurements of its alarms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from cavbench.driving.policy import Policy, State
from cavbench.isolation.modes import kept


class Alarms:
    """Counts the alarms of B episodes.

    Args:
        policy: the victim.
        batch: B.
        period: seconds per decision.
    """

    def __init__(self, policy: Policy, batch: int, period: float) -> None:
        self.policy, self.period = policy, period
        self.level, self.alarms = np.zeros(batch), np.zeros(batch)
        self.raised, self.falsified = np.zeros(batch, np.bool_), np.zeros(batch, np.bool_)
        self.waited, self.delay = np.zeros(batch), np.full(batch, np.inf)

    def step(self, shown: Tensor, state: State, running: NDArray[np.bool_], touched: NDArray[np.bool_]) -> None:
        """Count one step.

        Args:
            shown: the observation that the victim received, [B, V, F].
            state: its state before the step.
            running: bool [B], the episodes that were running.
            touched: bool [B], those whose observation was falsified.
        """
        with kept("defense"):
            found = self.policy.suspicion(shown, state)
        if found is None:
            self.level += np.nan
            return
        level, alarm = found.level.detach().numpy(), found.alarm.numpy() & running
        self.falsified |= touched
        np.maximum(self.level, level, out=self.level, where=running)
        self.alarms += alarm & ~self.raised
        self.raised = alarm
        caught = alarm & self.falsified & np.isinf(self.delay)
        self.delay[caught] = self.waited[caught] * self.period
        self.waited += self.falsified

    def columns(self) -> dict[str, NDArray[np.generic]]:
        """One value an episode; NaN for a victim without a monitor, and the delay where nothing was falsified."""
        silent = np.isnan(self.level)
        return {
            "suspicion": self.level,
            "alarms": np.where(silent, np.nan, self.alarms),
            "alarm_delay_s": np.where(silent | ~self.falsified, np.nan, self.delay),
        }
