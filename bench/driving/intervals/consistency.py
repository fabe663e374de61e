"""Whether what is shown fits how cars move: residuals that stay near 0 for true measurements, whatever the cars do."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench.driving.features import Features
from cavbench.driving.intervals.tracks import LONGITUDINAL

WINDOW_S = 3.0
"""Residuals are forgotten with this time constant, in s."""
SAME_CAR = 4.0
"""Two rows are of one car if prediction and measurement differ by at most this, in m and m/s together."""
ARRIVING_M = 6.0
"""A car that was not shown before may appear from this distance within the farthest row on, in m."""
BESIDE_M = 10.0
"""From this distance ahead on a car cannot have come from behind unseen, in m."""
NOISE_MPS = 0.35
"""What a true velocity may jump by beyond what a car can accelerate, on average, because the sensor is noisy, in m/s."""
END = 1 - 1e-5
"""The end of a feature's range on the normalised scale."""


class Residuals(NamedTuple):
    """How far the measurements are from what cars can do, [B] each: the largest one of all rows.

    Args:
        moved: difference between the way that a car was shown to move and the integral of the velocity that was shown, in m.
        jumped: changes of a car's velocity beyond its largest acceleration, summed, in m/s.
    """

    moved: Tensor
    jumped: Tensor


class Consistency:
    """Follows every shown car from frame to frame and adds up what does not fit.

    A true position changes by the integral of the true velocity, so their difference stays as small as the noise of one
    measurement. A lie about one of them, or a scaling of both, makes it grow.

    Args:
        features: features of the observation: x, y, vx and vy.
        period: seconds per decision.
    """

    def __init__(self, features: Features, period: float) -> None:
        self.features, self.period = features, period
        self.kept = 1 - period / WINDOW_S

    def initial(self, observation: Tensor) -> TensorDict:
        """The state before the first frame of observations [B, V, F]."""
        count, rows = observation.shape[0], observation.shape[1] - 1
        zero = observation.new_zeros(count, rows)
        return TensorDict(
            {
                "rows": observation.new_zeros(count, rows, 4),
                "present": zero.bool(),
                "moved": observation.new_zeros(count, rows, 2),
                "jumped": zero,
                "speed": observation.new_zeros(count),
                "known": observation.new_zeros(count, dtype=torch.bool),
            },
            batch_size=[count],
        )

    def step(self, observation: Tensor, reckoned: Tensor, state: TensorDictBase) -> TensorDict:
        """The state with an observation.

        Args:
            observation: what is shown, [B, V, F].
            reckoned: the ego's speed along the road from its actions, [B]; its change counts in the relative velocities.
            state: the state of the frame before.
        """
        rows = self.features.physical(observation)[:, 1:]
        # A value at the end of the sensor's range says nothing about motion.
        present = (observation[:, 1:, 0] > 0) & (observation[:, 1:, 1:].abs() < END).all(-1)
        before, known = state["rows"], state["known"].unsqueeze(-1)
        turned = rows[:, :, None, 2:] - before[:, None, :, 2:]
        # The mean of the two velocities counts.
        expected = before[..., :2] + before[..., 2:] * self.period
        place = rows[:, :, None, :2] - expected[:, None] - turned * (self.period / 2)
        # The ego's own acceleration changes all relative velocities. Across the road they may change at once.
        change = turned[..., 0] + (reckoned - state["speed"])[:, None, None]
        cost = place.abs().sum(-1) + change.abs()
        cost = torch.where(state["present"][:, None, :], cost, torch.inf)
        least, match = cost.min(-1)
        found = (least <= SAME_CAR) & present & known
        place = place.gather(2, match[:, :, None, None].expand(-1, -1, 1, 2)).squeeze(2)
        change = change.gather(2, match.unsqueeze(-1)).squeeze(-1)
        carried = state["moved"].gather(1, match.unsqueeze(-1).expand(-1, -1, 2)) * self.kept
        jumped = state["jumped"].gather(1, match) * self.kept
        excess = change.abs() - LONGITUDINAL * self.period - NOISE_MPS
        moved = torch.where(found.unsqueeze(-1), carried + place, 0.0)
        jumped = torch.where(found, (jumped + excess).clamp(min=0), 0.0)
        moved = moved + self._from_nowhere(rows, present & ~found & known, least, state).unsqueeze(-1)
        return TensorDict(
            {
                "rows": rows,
                "present": present,
                "moved": moved,
                "jumped": jumped,
                "speed": reckoned,
                "known": torch.ones_like(state["known"]),
            },
            batch_size=state.batch_size,
        )

    def residuals(self, state: TensorDictBase) -> Residuals:
        return Residuals(state["moved"].abs().flatten(1).amax(1), state["jumped"].amax(1))

    def _from_nowhere(self, rows: Tensor, strange: Tensor, least: Tensor, state: TensorDictBase) -> Tensor:
        """[B, V - 1] how far strange rows are from all predicted ones, if no car can have arrived there; 0 for the others."""
        distance = torch.where(state["present"], state["rows"][..., 0].abs(), 0.0).amax(-1, keepdim=True)
        # Cars that overtake come from behind, where the sensor sees little.
        inside = (rows[..., 0] > BESIDE_M) & (rows[..., 0] < distance - ARRIVING_M)
        return torch.where(strange & inside, least.clamp(max=10.0), 0.0)
