"""The TorchRL interface of the highway world, shared by the batched engine and the real highway-env."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from cavbench.driving.traffic import View
from cavbench.envs.highway.config import ACTIONS, HighwayConfig
from cavbench.envs.highway.engine import Flag, Number
from cavbench.scenarios import SeedBlock

GOLDEN_GAMMA = 0x9E3779B97F4A7C15
MASK_64 = 0xFFFFFFFFFFFFFFFF
DRAWN_SEEDS = 2**31 - SeedBlock.TRAIN


def drawn_seed(environment_seed: int, episode: int, reset: int) -> int:
    """The default scenario seed for the `reset`-th reset of row `episode`.

    It is a hash, so it does not depend on when the other rows ended. It is always in the training block of seeds.
    """
    value = 0
    for part in (environment_seed, episode, reset):
        value = ((value ^ part) + GOLDEN_GAMMA) & MASK_64
        value = (value ^ (value >> 30)) * 0xBF58476D1CE4E5B9 & MASK_64
        value = (value ^ (value >> 27)) * 0x94D049BB133111EB & MASK_64
        value ^= value >> 31
    return SeedBlock.TRAIN + value % DRAWN_SEEDS


class HighwayEnv(EnvBase):
    """B episodes of highway driving as a TorchRL environment (keys and shapes: `cavbench.driving.contracts.DrivingWorld`).

    Set `seed` (int64 [B]) in the tensordict of `reset` to select the scenarios; otherwise they follow from `set_seed`.
    A finished episode does not change until it is reset; `done` stays set and the reward is 0.
    """

    batch_locked = True

    def __init__(self, config: HighwayConfig) -> None:
        super().__init__(device="cpu", batch_size=torch.Size([config.batch]))
        self.config = config
        self._environment_seed = 0
        self._resets = np.zeros(config.batch, dtype=np.int64)
        self._make_specs(config.batch)

    @abstractmethod
    def _start(self, chosen: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        """Start the episodes `chosen` [R] from the scenario seeds [R]."""

    @abstractmethod
    def _drive(self, action: NDArray[np.generic], paused: NDArray[np.bool_] | None) -> None:
        """Execute one action [B] or [B, 2] in every unfinished episode that is not `paused` [B]."""

    def _order(self, orders: NDArray[np.float64], paused: NDArray[np.bool_] | None) -> None:
        """Give orders [B, N, 3] to cars of the traffic (`cavbench.driving.traffic.Orders`)."""
        raise NotImplementedError(f"{type(self).__name__} takes no orders for the traffic")

    def _view(self) -> NDArray[np.float64]:
        """[B, N, 7] the cars as an attacker that drives some of them sees them (`cavbench.driving.traffic.View`)."""
        raise NotImplementedError(f"{type(self).__name__} shows no traffic")

    @abstractmethod
    def _outputs(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        """The current observation [B, V, 5], numbers [5, B] (rows `Number`) and flags [5, B] (rows `Flag`)."""

    def _make_specs(self, batch: int) -> None:
        number = Unbounded(shape=(batch, 1), dtype=torch.float32)
        flag = Binary(1, shape=(batch, 1), dtype=torch.bool)
        info = Composite(
            progress=number, speed=number, x=number, ttc=number, crashed=flag, offroad=flag, shape=(batch,)
        )
        observation = Bounded(-1, 1, shape=(batch, self.config.observed_vehicles, 5), dtype=torch.float32)
        self.observation_spec = Composite(observation=observation, info=info, shape=(batch,))
        if self.config.traffic is not None:
            seen = Unbounded(shape=(batch, self.config.vehicles + 1, len(View._fields)), dtype=torch.float64)
            self.observation_spec["traffic"] = seen
        if self.config.action_type == "discrete":
            self.action_spec = Categorical(len(ACTIONS), shape=(batch,), dtype=torch.int64)
        else:
            self.action_spec = Bounded(-1, 1, shape=(batch, 2), dtype=torch.float32)
        self.reward_spec = number.clone()
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=(batch,))

    def _set_seed(self, seed: int | None) -> None:
        self._environment_seed = int(seed or 0)
        self._resets[:] = 0

    def _seeds(self, chosen: NDArray[np.int64], asked: Tensor | None) -> NDArray[np.int64]:
        """The scenario seeds of the episodes to start."""
        if asked is not None:
            return asked.reshape(-1).numpy().astype(np.int64)[chosen]
        resets = self._resets[chosen]
        self._resets[chosen] += 1
        drawn = [drawn_seed(self._environment_seed, int(b), int(n)) for b, n in zip(chosen, resets, strict=True)]
        return np.array(drawn, dtype=np.int64)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = asked = None
        if tensordict is not None:
            mask = tensordict.get("_reset", None)
            asked = tensordict.get("seed", None)
        chosen = np.arange(self.config.batch) if mask is None else np.flatnonzero(mask.reshape(-1).numpy())
        self._start(chosen, self._seeds(chosen, asked))
        return self._tensordict(with_reward=False)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        running = tensordict.get("_step", None)
        paused = None if running is None else ~running.reshape(-1).numpy()
        if (orders := tensordict.get("orders", None)) is not None:
            self._order(orders.numpy(), paused)
        self._drive(tensordict.get("action").numpy(), paused)
        return self._tensordict(with_reward=True)

    def _tensordict(self, *, with_reward: bool) -> TensorDictBase:
        """The outputs in new tensors, because rollouts keep them."""
        observation, numbers, flags = self._outputs()
        number = torch.from_numpy(numbers.copy()).unsqueeze(-1).unbind(0)
        flag = torch.from_numpy(flags.copy()).unsqueeze(-1).unbind(0)
        info = TensorDict(
            {
                "progress": number[Number.PROGRESS],
                "speed": number[Number.SPEED],
                "x": number[Number.X],
                "ttc": number[Number.TTC],
                "crashed": flag[Flag.CRASHED],
                "offroad": flag[Flag.OFFROAD],
            },
            batch_size=self.batch_size,
            device=self.device,
        )
        content = {
            "observation": torch.from_numpy(observation.copy()),
            "info": info,
            "done": flag[Flag.DONE],
            "terminated": flag[Flag.TERMINATED],
            "truncated": flag[Flag.TRUNCATED],
        }
        if with_reward:
            content["reward"] = number[Number.REWARD]
        if self.config.traffic is not None:
            content["traffic"] = torch.from_numpy(self._view())
        return TensorDict(content, batch_size=self.batch_size, device=self.device)
