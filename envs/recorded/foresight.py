"""Recorded roads for attackers: what moves there keeps its speed and its lane, and a recording is never looked at.

An observation has no target speeds and lanes. The ego's target speed follows from its last two speeds, that of another car is its
speed. A car aims for the lane where it will be soon.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench.envs.highway.dynamics import GAIN_SPEED
from cavbench.envs.roads.belief import LOOK_AHEAD_S
from cavbench.envs.roads.config import RoadsConfig
from cavbench.envs.roads.foresight import RoadsDynamics
from cavbench.envs.roads.state import Floats, Integers

PRESENCE, X = 0, 1
"""The first columns of an observation; y, vx and vy follow."""


class RecordedDynamics(RoadsDynamics):
    """The rules of motion on straight parallel lanes whose traffic was recorded: cars follow IDM and keep to their lane.

    Args:
        config: configuration with the road of each episode.
    """

    def __init__(self, config: RoadsConfig) -> None:
        super().__init__(config, changes_lanes=False)
        self.slots = config.observed_vehicles
        # An observation does not say how far the end of the road is.
        self.roads["end"] = np.inf

    def believe(self, observation: Tensor, before: TensorDictBase) -> TensorDict:
        rows = observation.numpy().astype(np.float64)
        measured = rows[..., X:] * self._half + self._centre
        there = rows[..., PRESENCE] > 0
        measured[:, 1:] += measured[:, :1]
        x, y, vx, vy = (measured[..., column] for column in range(4))
        speed = np.hypot(vx, vy)
        heading = np.where(speed > 0, np.arctan2(vy, vx), 0.0)
        aimed = speed.copy()
        aimed[:, 0] = self._aimed(speed[:, 0], before["speed"].numpy()[:, 0], before["count"].numpy() > 0)
        lane = self._lanes(before["network"].numpy(), y + LOOK_AHEAD_S * vy)
        nothing = np.zeros_like(x)
        # Rows without a car come last.
        fields = np.stack([x, y, speed, heading, aimed, lane, nothing, nothing], -1) * there[..., None]
        return self.believed(fields, there.sum(1), before, steps=before["steps"].numpy())

    def _lanes(self, networks: Integers, y: Floats) -> Integers:
        """The lane [B, V] that is nearest to a place across the road."""
        lanes = self.roads["lanes"]["start_y"][networks]
        exist = np.arange(lanes.shape[1]) < self.roads["lane_count"][networks][:, None]
        off = np.where(exist[:, None], np.abs(lanes[:, None] - y[..., None]), np.inf)
        return off.argmin(-1)

    def _aimed(self, now: Floats, before: Floats, known: NDArray[np.bool_]) -> Floats:
        """The target speed [B] of the ego: the one of the table that explains its last two speeds."""
        kept = (1 - GAIN_SPEED / self.config.simulation_frequency) ** self.config.substeps
        wanted = np.where(known, (now - before * kept) / (1 - kept), now)
        table = np.array(self.config.target_speeds)
        if self.action_type == "continuous":
            return now
        return np.asarray(table[np.abs(wanted[:, None] - table).argmin(1)], dtype=np.float64)
