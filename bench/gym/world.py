"""A world of the benchmark made of a gymnasium environment."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from bench.driving import ActionType, Driver, DrivingFacts, DrivingWorld
from bench.errors import UserError
from bench.gym.environment import drawn_seeds
from bench.scenarios import Cell

CONTROLS = 2


@dataclass(frozen=True, kw_only=True)
class GymWorld(DrivingWorld):
    """A world whose episodes are those of a gymnasium environment with a flat Box observation.

    A subclass sets `axes`, `grid`, `features`, `actions` and `hz`, has a field `max_steps`, and implements `environment`. Its
    `features` declare a name, a range, a unit and a floor for every entry of the observation: the range is what the sensor can
    measure (values outside are clipped), and attacks are limited in these units. Policies get one row, [1, 1 + n] on the
    [-1, 1] scale; those from files and from Python get the environment's own array (`DrivingFacts.flat`).

    The environments are stepped one after the other, so an episode costs what it costs in gymnasium.
    """

    hz: ClassVar[float]
    """Decisions per second."""

    @abstractmethod
    def environment(self, cell: Cell) -> gymnasium.Env[Any, Any]:
        """A new environment for a cell. The scenario seed is the `seed` of its `reset`."""

    def progress(self, reward: float, info: Mapping[str, Any]) -> float:
        """The share in [0, 1] of the best possible progress in a step, whose mean is `safe_progress`; by default the reward."""
        return min(max(reward, 0.0), 1.0)

    def failed(self, terminated: bool, info: Mapping[str, Any]) -> bool:
        """Whether the episode has failed, so that its score is 0; by default if it terminates before `max_steps`."""
        return terminated

    def measured(self, observation: NDArray[np.floating[Any]], info: Mapping[str, Any]) -> Mapping[str, float]:
        """Further truth for the records: `speed` in m/s, `x` in m, `ttc` in s; by default 0, 0 and infinity."""
        return {}

    @property
    def decision_hz(self) -> float:
        return self.hz

    @property
    def facts(self) -> DrivingFacts:
        return DrivingFacts(
            axes=self.axes,
            decision_hz=self.hz,
            max_steps=self.max_steps,
            actions=self.actions,
            features=self.features,
            flat=True,
        )

    def make(
        self,
        cells: Sequence[Cell],
        *,
        action_type: ActionType = "discrete",
        driver: Driver = "agent",
        action_repeat: int = 1,
    ) -> EnvBase:
        """See `bench.driving.DrivingWorld.make`; an action is never repeated.

        Raises:
            UserError: if the spaces of an environment are not those that the world declares.
        """
        if driver != "agent" or action_repeat != 1:
            raise UserError(f"{type(self).__name__} has no driver of its own and repeats no actions")
        return _Batch(self, cells, action_type)


class _Batch(EnvBase):
    """The environments of B cells as one TorchRL environment."""

    batch_locked = True

    def __init__(self, world: GymWorld, cells: Sequence[Cell], action_type: ActionType) -> None:
        size = len(cells)
        super().__init__(device="cpu", batch_size=torch.Size([size]))
        self.world, self.discrete = world, action_type == "discrete"
        self.envs = [world.environment(cell) for cell in cells]
        for env in self.envs:
            _check(world, env, action_type)
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
        self.action_spec = Categorical(actions, (size,)) if self.discrete else Bounded(-1, 1, (size, CONTROLS))
        self.reward_spec = number
        self.done_spec = Composite(done=flag, terminated=flag, truncated=flag, shape=(size,))

    def _set_seed(self, seed: int | None) -> None:
        self.generator = np.random.default_rng(seed or 0)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        asked = None if tensordict is None else tensordict.get("seed", None)
        seeds = drawn_seeds(self.generator, len(self.envs)) if asked is None else asked.reshape(-1).numpy()
        chosen = np.arange(len(self.envs)) if mask is None else np.flatnonzero(mask.reshape(-1).numpy())
        for values in (*self.numbers.values(), *self.flags.values()):
            values[chosen] = 0
        self.time[chosen] = 0
        for place in chosen.tolist():
            observation, info = self.envs[place].reset(seed=int(seeds[place]) % 2**32)
            self._set(place, observation, info)
        return self._output()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict["action"].numpy()
        self.numbers["reward"][:] = 0
        for place in np.flatnonzero(~self.flags["done"][:, 0]).tolist():
            self._advance(place, actions[place])
        return self._output().set("reward", torch.from_numpy(self.numbers["reward"].copy()))

    def _advance(self, place: int, action: NDArray[np.generic]) -> None:
        """One step of one environment."""
        world, env = self.world, self.envs[place]
        observation, reward, terminated, truncated, info = env.step(
            int(action) if self.discrete else self._scaled(action)
        )
        self.time[place] += 1
        self.numbers["reward"][place] = reward
        self.numbers["progress"][place] = world.progress(float(reward), info)
        self.flags["crashed"][place] = world.failed(bool(terminated), info)
        over = bool(truncated) or self.time[place] >= world.max_steps
        ends = {"terminated": bool(terminated), "truncated": over and not terminated, "done": over or bool(terminated)}
        for name, value in ends.items():
            self.flags[name][place] = value
        self._set(place, observation, info)

    def _scaled(self, action: NDArray[np.generic]) -> NDArray[np.generic]:
        """An action in [-1, 1] on the range of the environment's actions."""
        space = self.envs[0].action_space
        assert isinstance(space, spaces.Box)
        share = (np.asarray(action, np.float64) + 1) / 2
        return (space.low + share * (space.high - space.low)).astype(space.dtype)

    def _set(self, place: int, observation: NDArray[np.floating[Any]], info: Mapping[str, Any]) -> None:
        self.seen[place, 0, 1:] = np.clip((np.asarray(observation, np.float64) - self.centre) / self.half, -1, 1)
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


def _check(world: GymWorld, env: gymnasium.Env[Any, Any], action_type: ActionType) -> None:
    """Refuse an environment whose spaces are not those of the world.

    Raises:
        UserError: says what differs.
    """
    name, count = type(world).__name__, len(world.features.names)
    if not isinstance(env.observation_space, spaces.Box) or env.observation_space.shape != (count,):
        raise UserError(f"{name} declares {count} features, its environment observes {env.observation_space}")
    action = env.action_space
    if action_type == "discrete" and not (isinstance(action, spaces.Discrete) and action.n == len(world.actions)):
        raise UserError(f"{name} names {len(world.actions)} discrete actions, its environment takes {action}")
    if action_type == "continuous" and not (isinstance(action, spaces.Box) and action.shape == (CONTROLS,)):
        raise UserError(f"continuous policies have {CONTROLS} controls, the environment of {name} takes {action}")
