"""Many episodes of a driving world at once, as a gymnasium vector environment."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDict

from bench.driving import ActionType, DrivingWorld
from bench.gym.environment import Observation, drawn_seeds, spaces_of, world_and_cells
from bench.scenarios import Cell


class DrivingVectorEnv(VectorEnv[Observation, Any, NDArray[Any]]):
    """B episodes in one batch of the engine, which on the highway is many times faster than B environments.

    Observations, rewards and `info` are those of `bench.gym.DrivingEnv`, in arrays [B, ...]. Episode b is on cell b, counted
    around. An episode that has ended is reset in the next step (gymnasium's `NEXT_STEP`): the world must support partial resets.

    Args:
        world: the world.
        cells: cells of the episodes, in turn.
        num_envs: B.
        action_type: discrete or continuous.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 - as gymnasium has it

    def __init__(
        self, world: DrivingWorld, cells: tuple[Cell, ...], num_envs: int, action_type: ActionType = "discrete"
    ) -> None:
        self.num_envs, self.cells = num_envs, tuple(cells[number % len(cells)] for number in range(num_envs))
        self._env = world.make(self.cells, action_type=action_type)
        shape = self._env.observation_spec["observation"]
        self.single_observation_space, self.single_action_space = spaces_of(shape, world, action_type)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended = np.zeros(num_envs, np.bool_)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start all episodes. `seed`, one number, fixes them and those after them."""
        first = seed[0] if isinstance(seed, list) else seed
        super().reset(seed=first)
        self._td = self._env.reset(TensorDict({"seed": self._seeds()}, batch_size=[self.num_envs]))
        self._ended[:] = False
        return self._td["observation"].numpy(), self._info()

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Observation, NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Carry out an action [B] or [B, 2] in each episode; those that had ended begin anew, with reward 0."""
        self._td = self._env.step(self._td.set("action", torch.as_tensor(np.asarray(actions))))["next"]
        reward, terminated, truncated = (
            self._td[name].squeeze(-1).numpy().copy() for name in ("reward", "terminated", "truncated")
        )
        if self._ended.any():
            asked = self._td.set("_reset", torch.from_numpy(self._ended)[:, None]).set("seed", self._seeds())
            self._td = self._env.reset(asked)
            reward[self._ended] = 0
            terminated &= ~self._ended
            truncated &= ~self._ended
        truncated &= ~terminated
        self._ended = terminated | truncated
        return self._td["observation"].numpy(), reward, terminated, truncated, self._info()

    def close_extras(self, **kwargs: Any) -> None:
        """Close the engine."""
        self._env.close(raise_if_closed=False)

    def _seeds(self) -> torch.Tensor:
        return torch.from_numpy(drawn_seeds(self.np_random, self.num_envs))

    def _info(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, value in self._td["info"].items():
            found |= {name: value.squeeze(-1).numpy(), f"_{name}": np.ones(self.num_envs, np.bool_)}
        return found


def make_vec(
    world: str | DrivingWorld = "highway", *, num_envs: int, action_type: ActionType = "discrete", **options: Any
) -> DrivingVectorEnv:
    """The vector environment of a world; arguments as in `bench.gym.make`.

    Raises:
        UserError: as `bench.gym.make`.
    """
    world_, cells = world_and_cells(world, options)
    return DrivingVectorEnv(world_, cells, num_envs, action_type)
