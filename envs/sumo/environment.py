"""The worlds with SUMO's traffic as TorchRL environments."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.highway.config import HighwayConfig
from cavbench.envs.highway.environment import HighwayEnv
from cavbench.envs.sumo.engine import Scene, SumoEngine


class SumoEnv(HighwayEnv):
    """B episodes in SUMO's traffic (keys and shapes: `cavbench.driving.contracts.DrivingWorld`).

    Args:
        config: of `highway`.
        scene: where.
        processes: number of simulations that hold the batch.
    """

    def __init__(self, config: HighwayConfig, scene: Scene, processes: int = 1) -> None:
        super().__init__(config)
        self.engine = SumoEngine(config, scene, processes)

    def _start(self, chosen: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        self.engine.reset(chosen, seeds)

    def _drive(self, action: NDArray[np.generic], paused: NDArray[np.bool_] | None) -> None:
        self.engine.step(action, paused)

    def _outputs(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        return self.engine.observation, self.engine.numbers, self.engine.flags

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End the simulations; see `torchrl.envs.EnvBase.close`."""
        self.engine.processes.close()
        super().close(raise_if_closed=raise_if_closed)
