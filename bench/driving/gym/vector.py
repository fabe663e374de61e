"""Many episodes of a driving world at once, as a gymnasium vector environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from cavbench.driving import ActionType, DrivingWorld
from cavbench.driving.gym.environment import (
    Observation,
    checked_actions,
    checked_seed,
    drawn_seeds,
    spaces_of,
    world_and_cells,
)
from cavbench.errors import UserError
from cavbench.scenarios import Cell

Seeds = int | Sequence[int | None] | NDArray[np.integer[Any]] | None
MASK = "reset_mask"
"""The option of `reset` that names the episodes to start (gymnasium)."""


class DrivingVectorEnv(VectorEnv[Observation, Any, NDArray[Any]]):
    """B episodes in one batch of the engine, which on the highway is many times faster than B environments.

    Observations, rewards and `info` are those of `cavbench.gym.DrivingEnv`, in arrays [B, ...]. Episode b is on cell b, counted
    around, and draws its scenarios as a `DrivingEnv` of this cell does that was reset with the same seed. An episode that has
    ended is reset in the next step (gymnasium's `NEXT_STEP`): the world must support partial resets.

    Args:
        world: the world.
        cells: cells of the episodes, in turn.
        num_envs: B.
        action_type: discrete or continuous.

    Raises:
        UserError: if there are no episodes.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 - as gymnasium has it

    def __init__(
        self, world: DrivingWorld, cells: tuple[Cell, ...], num_envs: int, action_type: ActionType = "discrete"
    ) -> None:
        if num_envs < 1:
            raise UserError(f"num_envs must be at least 1, got {num_envs}")
        self.num_envs, self.cells = num_envs, tuple(cells[number % len(cells)] for number in range(num_envs))
        self.action_type, self._controls = action_type, len(world.facts.controls)
        self._env = world.make(self.cells, action_type=action_type)
        self._td: TensorDictBase = TensorDict({}, batch_size=[num_envs])
        shape = self._env.observation_spec["observation"]
        self.single_observation_space, self.single_action_space = spaces_of(shape, world, action_type)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators: list[np.random.Generator] = []
        self._seeds: tuple[int, ...] = ()
        self._scenarios = np.zeros(num_envs, np.int64)
        self._ended = np.zeros(num_envs, np.bool_)

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:
        """The generator of each episode's scenarios, as in gymnasium's `SyncVectorEnv`."""
        return tuple(self._generators)

    @property
    def np_random_seed(self) -> tuple[int, ...]:
        """The seed of each generator."""
        return self._seeds

    def reset(self, *, seed: Seeds = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Start all episodes, or those of a mask, as gymnasium's `SyncVectorEnv` does.

        Args:
            seed: fixes the episodes and those after them: a list with the seed of each, or s for [s, s + 1, ...]. Where it is
                None an episode draws on from its generator.
            options: `{"reset_mask": mask}` with bool [B] starts these episodes only.

        Raises:
            UserError: if a seed is not a whole number of at least 0, their number is not B, the mask is not bool [B] with at
                least one True, or there is another option.
        """
        seeds, chosen = self._listed(seed), self._masked(options)
        if not self._generators:
            self._generators, self._seeds = _generators(seeds)
        else:
            fresh, known = _generators([one if asked else None for one, asked in zip(seeds, chosen, strict=True)])
            given = [one is not None and bool(asked) for one, asked in zip(seeds, chosen, strict=True)]
            self._generators = [
                new if take else old for new, old, take in zip(fresh, self._generators, given, strict=True)
            ]
            self._seeds = tuple(new if take else old for new, old, take in zip(known, self._seeds, given, strict=True))
        self._begin(chosen)
        self._ended &= ~chosen
        return self._td["observation"].numpy(), self._info(chosen)

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Observation, NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Carry out an action [B] or [B, 2] in each episode; those that had ended begin anew, with reward 0.

        Raises:
            UserError: if the actions are not in the action space.
        """
        given = checked_actions(actions, self.action_type, (self.num_envs,), self._controls)
        self._td = self._env.step(self._td.set("action", torch.from_numpy(given)))["next"]
        reward, terminated, truncated = (
            self._td[name].squeeze(-1).numpy().copy() for name in ("reward", "terminated", "truncated")
        )
        if self._ended.any():
            self._begin(self._ended)
            reward[self._ended] = 0
            terminated &= ~self._ended
            truncated &= ~self._ended
        truncated &= ~terminated
        self._ended = terminated | truncated
        return self._td["observation"].numpy(), reward, terminated, truncated, self._info(np.ones_like(self._ended))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the engine."""
        self._env.close(raise_if_closed=False)

    def _begin(self, chosen: NDArray[np.bool_]) -> None:
        """Start some episodes [B] on the next scenario of their generators."""
        for place in np.flatnonzero(chosen):
            self._scenarios[place] = drawn_seeds(self._generators[place], 1)[0]
        asked = TensorDict({"seed": torch.from_numpy(self._scenarios.copy())}, batch_size=[self.num_envs])
        if not chosen.all():
            asked = self._td.update(asked).set("_reset", torch.from_numpy(chosen.copy())[:, None])
        self._td = self._env.reset(asked)

    def _listed(self, seed: Seeds) -> list[int | None]:
        """The seed of each episode."""
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, Sequence | np.ndarray) and np.ndim(np.asarray(seed, object)) == 1:
            if len(seed) != self.num_envs:
                raise UserError(f"a list of seeds has one for each of the {self.num_envs} episodes, got {len(seed)}")
            return [checked_seed(one) for one in seed]
        first = checked_seed(seed) or 0
        return list(range(first, first + self.num_envs))

    def _masked(self, options: dict[str, Any] | None) -> NDArray[np.bool_]:
        """[B] the episodes to start."""
        mask = np.ones(self.num_envs, np.bool_)
        if not options:
            return mask
        if strange := [name for name in options if name != MASK]:
            raise UserError(
                f"reset takes the option {MASK!r} only, got {strange[0]!r}: the axes are arguments of make_vec"
            )
        mask = np.asarray(options[MASK])
        if mask.dtype != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise UserError(
                f"options[{MASK!r}] is a bool array of shape [{self.num_envs}] with at least one True, got {mask}"
            )
        if not self._generators and not mask.all():
            raise UserError(f"the first reset starts all episodes: leave out options[{MASK!r}]")
        return mask

    def _info(self, known: NDArray[np.bool_]) -> dict[str, Any]:
        """What is known of the episodes `known` [B], in gymnasium's form: each entry has a mask of the same name."""
        found: dict[str, Any] = {name: value.squeeze(-1).numpy() for name, value in self._td["info"].items()}
        found["scenario"] = self._scenarios.copy()
        found["cell"] = {name: np.array([cell[name] for cell in self.cells]) for name in self.cells[0]}
        found["cell"] |= {f"_{name}": known.copy() for name in self.cells[0]}
        return found | {f"_{name}": known.copy() for name in found}


def _generators(seeds: Sequence[int | None]) -> tuple[list[np.random.Generator], tuple[int, ...]]:
    """A generator for each seed, which `DrivingEnv` has for the same one, and the seeds; for None it is drawn."""
    made = [seeding.np_random(seed) for seed in seeds]
    return [generator for generator, _ in made], tuple(int(seed) for _, seed in made)


def make_vec(
    world: str | DrivingWorld = "highway", *, num_envs: int, action_type: ActionType = "discrete", **options: Any
) -> DrivingVectorEnv:
    """The vector environment of a world; arguments as in `cavbench.gym.make`.

    Raises:
        UserError: as `cavbench.gym.make`.
    """
    world_, cells = world_and_cells(world, options)
    return DrivingVectorEnv(world_, cells, num_envs, action_type)
