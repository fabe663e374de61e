"""The worlds of road networks as TorchRL environments."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.highway.environment import HighwayEnv
from cavbench.envs.roads.clairvoyant import RoadsPlanner
from cavbench.envs.roads.config import RoadsConfig
from cavbench.envs.roads.engine import RoadsEngine


class RoadsEnv(HighwayEnv):
    """B episodes on road networks (keys and shapes: `cavbench.driving.contracts.DrivingWorld`).

    >>> env = RoadsEnv(MergeWorld().config((AXES.cell(density=1.0, ramp=80.0),) * 64))
    >>> env.rollout(300, break_when_all_done=True)
    """

    def __init__(self, config: RoadsConfig) -> None:
        # The interface of the highway reads batch, action_type and observed_vehicles, which both configurations have.
        super().__init__(config)  # type: ignore[arg-type]
        self.engine = RoadsEngine(config)
        self.clairvoyant = RoadsPlanner(self.engine) if config.driver == "clairvoyant" else None

    def _start(self, chosen: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        self.engine.reset(chosen, seeds)

    def _drive(self, action: NDArray[np.generic], paused: NDArray[np.bool_] | None) -> None:
        self.engine.step(action if self.clairvoyant is None else self.clairvoyant.actions(), paused)

    def _outputs(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        return self.engine.observation, self.engine.numbers, self.engine.flags
