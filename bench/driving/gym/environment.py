"""A driving world as a gymnasium environment, to train policies in with any library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from cavbench.core import registry
from cavbench.core.pair import choose
from cavbench.driving import ActionType, DrivingWorld
from cavbench.errors import UserError
from cavbench.scenarios import Cell, Grid, SeedBlock

LAST_SEED = 2**31
Observation = NDArray[np.float32]


class DrivingEnv(gymnasium.Env[Observation, Any]):
    """One episode at a time of a driving world. `reset` draws a cell and a scenario that no score is reported on.

    The observation is float32 [V, F] in [-1, 1], as policies get it in a run (`cavbench.driving.Features`). The reward is the
    world's: on the highway highway-env's, normalised to [0, 1] a step, whose sum is the `return` of records. `info` has the truth
    for scoring: `progress`, `speed`, `x`, `ttc`, `crashed` and `offroad` (`cavbench.driving.DrivingWorld`), `cell`, `scenario`.

    Args:
        world: the world.
        cells: an episode is on one of them.
        action_type: `discrete`: the actions of the world by number; `continuous`: [acceleration, steering] in [-1, 1].
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    _td: TensorDictBase

    def __init__(self, world: DrivingWorld, cells: Sequence[Cell], action_type: ActionType = "discrete") -> None:
        self.world, self.cells, self.action_type = world, tuple(cells), action_type
        self._envs: dict[Cell, EnvBase] = {}
        self._begin(self.cells[0], SeedBlock.TRAIN)
        self.observation_space, self.action_space = spaces_of(self._td["observation"], world, action_type)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode. `seed` fixes it and those after it.

        Raises:
            UserError: if the seed is not a whole number of at least 0, or there are options.
        """
        if options:
            raise UserError(
                f"reset takes no options, got {', '.join(map(repr, options))}: the axes are arguments of make"
            )
        super().reset(seed=checked_seed(seed))
        self.cell = self.cells[int(self.np_random.integers(len(self.cells)))]
        self.scenario = int(drawn_seeds(self.np_random, 1)[0])
        self._begin(self.cell, self.scenario)
        return self._td["observation"][0].numpy(), self._info()

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Carry out an action.

        Raises:
            UserError: if it is not in the action space.
        """
        controls = len(self.world.facts.controls)
        batch = torch.as_tensor(checked_actions(action, self.action_type, (), controls)).unsqueeze(0)
        self._td = self._env.step(self._td.set("action", batch))["next"]
        reward, terminated, truncated = (self._td[name].item() for name in ("reward", "terminated", "truncated"))
        return self._td["observation"][0].numpy(), reward, terminated, truncated and not terminated, self._info()

    def close(self) -> None:
        """Close the environments of all cells."""
        for env in self._envs.values():
            env.close(raise_if_closed=False)

    def _begin(self, cell: Cell, seed: int) -> None:
        if cell not in self._envs:
            self._envs[cell] = self.world.make([cell], action_type=self.action_type)
        self._env = self._envs[cell]
        self._td = self._env.reset(TensorDict({"seed": torch.tensor([seed])}, batch_size=[1]))

    def _info(self) -> dict[str, Any]:
        measured = {name: value.item() for name, value in self._td["info"].items()}
        return {**measured, "cell": dict(self.cell), "scenario": self.scenario}


def make(world: str | DrivingWorld = "highway", *, action_type: ActionType = "discrete", **options: Any) -> DrivingEnv:
    """The environment of a world; `gymnasium.make("cavbench/highway-v0", lanes=3)` after `import cavbench.gym` is the same.

    Args:
        world: a name, as on the command line, or a world.
        action_type: discrete or continuous.
        options: values on the axes of the world, one or a sequence each, of which every episode draws one (lanes=[3, 4]; by
            default those of its grid); and, if `world` is a name, its parameters (vehicles=10).

    Raises:
        UserError: if there is no such world, axis or parameter, or a value is not allowed.
    """
    return DrivingEnv(*world_and_cells(world, options), action_type)


def world_and_cells(world: str | DrivingWorld, options: Mapping[str, Any]) -> tuple[DrivingWorld, tuple[Cell, ...]]:
    """The world, and its cells with these values on its axes; the other options are parameters of the world."""
    known = registry.load("world", world).axes if isinstance(world, str) else world.axes
    # The axes of the world `gym` are one of its parameters.
    known = known or {}
    made: Any = world
    parameters = {name: value for name, value in options.items() if name not in known}
    if isinstance(world, str):
        made = choose("world", world, **parameters).component
    elif parameters:
        raise UserError(registry.unknown(f"axis {next(iter(parameters))!r}", next(iter(parameters)), known))
    if not isinstance(made, DrivingWorld):
        raise UserError(f"world {world!r} is not a driving world")
    return made, _cells(made, {name: value for name, value in options.items() if name in known})


def _cells(world: DrivingWorld, given: Mapping[str, Any]) -> tuple[Cell, ...]:
    values = {name: tuple(value) if isinstance(value, list | tuple) else (value,) for name, value in given.items()}
    try:
        if set(values) == set(world.axes) and values:
            grid = Grid(name="custom", world="", axes=world.axes, values=values, episodes=1)
        else:
            grid = registry.grid_of(world)
            grid = replace(grid, values={**grid.values, **values})
        return grid.cells()
    except ValueError as error:
        raise UserError(str(error).splitlines()[0]) from error


def spaces_of(
    observation: torch.Tensor, world: DrivingWorld, action_type: ActionType
) -> tuple[spaces.Box, spaces.Discrete | spaces.Box]:
    """The observation space and the action space of one episode, from observations [B, V, F]."""
    # As highway-env declares it, although the values are in [-1, 1]: a policy can be trained here or there.
    end = np.inf if world.facts.unbounded else 1.0
    shown = spaces.Box(-end, end, tuple(observation.shape[1:]), np.float32)
    if action_type == "discrete":
        return shown, spaces.Discrete(len(world.actions))
    return shown, spaces.Box(-1.0, 1.0, (len(world.facts.controls),), np.float32)


def checked_seed(seed: Any) -> int | None:
    """A seed of `reset` as Python's own number; None stays None.

    Raises:
        UserError: if it is not a whole number of at least 0.
    """
    if seed is None:
        return None
    if isinstance(seed, bool | np.bool_) or not isinstance(seed, int | np.integer) or seed < 0:
        raise UserError(f"a seed is a whole number of at least 0, got {seed!r}")
    return int(seed)


def checked_actions(actions: Any, action_type: ActionType, leading: tuple[int, ...], controls: int) -> NDArray[Any]:
    """The actions as the engine takes them: int64 [*leading], or float32 [*leading, controls].

    Raises:
        UserError: if they have another shape or type. Their range is checked by the world.
    """
    found = np.asarray(actions)
    shape = leading if action_type == "discrete" else (*leading, controls)
    kinds = "iu" if action_type == "discrete" else "iuf"
    if found.shape != shape or found.dtype.kind not in kinds:
        what = "whole numbers" if action_type == "discrete" else "numbers"
        raise UserError(
            f"{action_type} actions are {what} of shape {list(shape)}, got {found.dtype} {list(found.shape)}"
        )
    if not np.isfinite(found).all():
        raise UserError("an action is NaN or infinite")
    return found.astype(np.int64 if action_type == "discrete" else np.float32)


def drawn_seeds(generator: np.random.Generator, count: int) -> NDArray[np.int64]:
    """Scenario seeds for a training, which are never reported."""
    return generator.integers(SeedBlock.TRAIN, LAST_SEED, count, dtype=np.int64)
