"""The environments of the cells of a `GymWorld` as one TorchRL environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from cavbench.driving import ActionType
from cavbench.driving.gym.declaration import REWARD, Declaration
from cavbench.driving.gym.declared import check
from cavbench.driving.gym.environment import drawn_seeds
from cavbench.errors import UserError
from cavbench.scenarios import Cell

ROUNDING = 1e-6
"""A progress may be this far outside [0, 1]."""
BITS_32 = 2**32


class Witness(Protocol):
    """Is told what the environments return, before anything is clipped."""

    def saw(self, observation: NDArray[np.float64]) -> None:
        """An observation [n] of one environment, in its own units."""

    def earned(self, reward: float, info: Mapping[str, Any]) -> None:
        """The reward of one step of one environment, and what it told."""


class Batch(EnvBase):
    """The environments of B cells, stepped one after the other; an episode that has ended waits for its reset.

    Args:
        world: the world.
        cells: the cell of each episode.
        action_type: discrete or continuous.
        witness: sees the raw values; None for nobody.

    Raises:
        UserError: if the spaces of an environment are not those that the world declares, or two episodes have the same one.
    """

    batch_locked = True

    def __init__(
        self, world: Declaration, cells: Sequence[Cell], action_type: ActionType, witness: Witness | None = None
    ) -> None:
        size = len(cells)
        super().__init__(device="cpu", batch_size=torch.Size([size]))
        self.world, self.discrete, self.witness = world, action_type == "discrete", witness
        self.envs = [world.environment(cell) for cell in cells]
        if len({id(env.unwrapped) for env in self.envs}) < size:
            raise UserError(
                f"{world.source} returned the same environment for two episodes, which are driven in turn: "
                "make a new one in each call"
            )
        for env in self.envs:
            check(world, env, action_type)
        features = world.features
        self.centre, self.half = (
            ((np.array(features.high) + sign * np.array(features.low)) / 2).astype(np.float64) for sign in (1, -1)
        )
        self.generator = np.random.default_rng(0)
        self.numbers = {name: np.zeros((size, 1), np.float32) for name in ("reward", "progress", "speed", "x", "ttc")}
        self.flags = {name: np.zeros((size, 1), np.bool_) for name in ("crashed", "terminated", "truncated", "done")}
        self.time = np.zeros(size, np.int64)
        self.seen = np.ones((size, 1, 1 + len(features.names)), np.float32)
        self._make_specs(size)

    def _make_specs(self, size: int) -> None:
        flag, number = Binary(1, (size, 1), dtype=torch.bool), Unbounded((size, 1))
        info = dict.fromkeys(("progress", "speed", "x", "ttc"), number) | {"crashed": flag, "offroad": flag}
        self.observation_spec = Composite(
            observation=Bounded(-1, 1, self.seen.shape), info=Composite(info, shape=(size,)), shape=(size,)
        )
        actions = len(self.world.actions)
        controls = len(self.world.controls)
        self.action_spec = Categorical(actions, (size,)) if self.discrete else Bounded(-1, 1, (size, controls))
        self.reward_spec = number
        self.done_spec = Composite(done=flag, terminated=flag, truncated=flag, shape=(size,))

    def _set_seed(self, seed: int | None) -> None:
        self.generator = np.random.default_rng(seed or 0)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        asked = None if tensordict is None else tensordict.get("seed", None)
        seeds = drawn_seeds(self.generator, len(self.envs)) if asked is None else asked.reshape(-1).numpy()
        chosen = np.arange(len(self.envs)) if mask is None else np.flatnonzero(mask.reshape(-1).numpy())
        if len(chosen) and (lowest := int(seeds[chosen].min())) < 0:
            raise ValueError(f"scenario seeds must be at least 0, got {lowest}")
        for values in (*self.numbers.values(), *self.flags.values()):
            values[chosen] = 0
        self.time[chosen] = 0
        for place in chosen.tolist():
            observation, info = self.envs[place].reset(seed=int(seeds[place]) % BITS_32)
            self._set(place, observation, info)
        return self._output()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict["action"].numpy()
        self.numbers["reward"][:] = 0
        self.numbers["progress"][:] = 0
        for place in np.flatnonzero(~self.flags["done"][:, 0]).tolist():
            self._advance(place, actions[place])
        return self._output().set("reward", torch.from_numpy(self.numbers["reward"].copy()))

    def _advance(self, place: int, action: NDArray[np.generic]) -> None:
        """One step of one environment."""
        world, env = self.world, self.envs[place]
        observation, reward, terminated, truncated, info = env.step(self._own(env.action_space, action))
        if self.witness is not None:
            self.witness.earned(float(reward), info)
        self.time[place] += 1
        self.numbers["reward"][place] = reward
        failed = bool(world.failed(bool(terminated), {REWARD: float(reward), **info}))
        # Who arrives earlier is no worse than who arrives later.
        left = world.max_steps - self.time[place] if terminated and not failed else 0
        self.numbers["progress"][place] = _share(world, world.progress(float(reward), info)) + left
        self.flags["crashed"][place] = failed
        over = bool(truncated) or self.time[place] >= world.max_steps
        ends = {"terminated": bool(terminated), "truncated": over and not terminated, "done": over or bool(terminated)}
        for name, value in ends.items():
            self.flags[name][place] = value
        self._set(place, observation, info)

    def _own(self, space: spaces.Space[Any], action: NDArray[np.generic]) -> Any:
        """An action in the format of an environment: its number, or the point of its range for controls in [-1, 1]."""
        if self.discrete:
            assert isinstance(space, spaces.Discrete)
            return int(space.start) + int(action)
        assert isinstance(space, spaces.Box)
        share = (np.clip(np.asarray(action, np.float64).reshape(space.shape), -1, 1) + 1) / 2
        return (space.low + share * (space.high - space.low)).astype(space.dtype)

    def _set(self, place: int, observation: Any, info: Mapping[str, Any]) -> None:
        raw = np.asarray(spaces.flatten(self.envs[place].observation_space, observation), np.float64)
        if self.witness is not None:
            self.witness.saw(raw)
        self.seen[place, 0, 1:] = np.clip((raw - self.centre) / self.half, -1, 1)
        for name, value in {"speed": 0.0, "x": 0.0, "ttc": np.inf, **self.world.measured(observation, info)}.items():
            self.numbers[name][place] = value

    def _output(self) -> TensorDict:
        info: dict[str, NDArray[Any]] = {name: self.numbers[name] for name in ("progress", "speed", "x", "ttc")}
        info |= {"crashed": self.flags["crashed"], "offroad": np.zeros_like(self.flags["crashed"])}
        ends = {name: torch.from_numpy(self.flags[name].copy()) for name in ("done", "terminated", "truncated")}
        truth = TensorDict({name: torch.from_numpy(value.copy()) for name, value in info.items()}, self.batch_size)
        return TensorDict({"observation": torch.from_numpy(self.seen.copy()), "info": truth, **ends}, self.batch_size)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close all environments."""
        for env in self.envs:
            env.close()
        super().close(raise_if_closed=raise_if_closed)


def _share(world: Declaration, progress: float) -> float:
    """A progress that is one.

    Raises:
        UserError: if it is not in [0, 1].
    """
    if not -ROUNDING <= progress <= 1 + ROUNDING:
        raise UserError(f"{world.label}.progress returned {progress:g}: return a share in [0, 1]")
    return min(max(progress, 0.0), 1.0)
