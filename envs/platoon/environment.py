"""The world `platoon` as a TorchRL environment."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.data import Bounded, Categorical, Unbounded

from cavbench.envs.highway.config import HighwayConfig
from cavbench.envs.highway.engine import Number
from cavbench.envs.highway.environment import HighwayEnv
from cavbench.envs.platoon import kernels
from cavbench.envs.platoon.engine import COMMANDS, WIDTH, PlatoonConfig, PlatoonEngine

OWN = {"time_gap": kernels.TIME_GAP, "acceleration": kernels.OWN, "acceleration_ahead": kernels.AHEAD}


class PlatoonEnv(HighwayEnv):
    """B platoons (keys and shapes: `cavbench.driving.contracts.DrivingWorld`).

    Further keys of `info`: `time_gap` in s, `acceleration` and `acceleration_ahead` in m/s2 of the driven car and of the one
    ahead, float32 [B, 1] each.
    """

    def __init__(self, config: PlatoonConfig) -> None:
        super().__init__(cast(HighwayConfig, config))
        self.engine = PlatoonEngine(config)

    def _make_specs(self, batch: int) -> None:
        super()._make_specs(batch)
        rows = self.config.observed_vehicles
        self.observation_spec["observation"] = Bounded(-1, 1, shape=(batch, rows, WIDTH), dtype=torch.float32)
        for name in OWN:
            self.observation_spec["info", name] = Unbounded(shape=(batch, 1), dtype=torch.float32)
        if self.config.action_type == "discrete":
            self.action_spec = Categorical(len(COMMANDS), shape=(batch,), dtype=torch.int64)
        else:
            self.action_spec = Bounded(-1, 1, shape=(batch, 1), dtype=torch.float32)

    def _start(self, chosen: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        self.engine.reset(chosen, seeds)

    def _drive(self, action: NDArray[Any], paused: NDArray[np.bool_] | None) -> None:
        self.engine.step(action, paused)

    def _outputs(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        platoons, numbers = self.engine.platoons, self.engine.numbers.T.astype(np.float32)
        truncated = platoons.done & ~platoons.crashed
        flags = np.stack((platoons.done, platoons.crashed, truncated, platoons.crashed, np.zeros_like(truncated)))
        return self.engine.observation, numbers[: len(Number)], flags

    def _tensordict(self, *, with_reward: bool) -> TensorDictBase:
        found = super()._tensordict(with_reward=with_reward)
        for name, column in OWN.items():
            found["info", name] = torch.from_numpy(self.engine.numbers[:, column].astype(np.float32)).unsqueeze(-1)
        return found
