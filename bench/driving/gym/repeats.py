"""Whether an episode of a `GymWorld` is the same whenever, and beside whatever else, it is driven."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import closing

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from cavbench.driving import ActionType
from cavbench.driving.gym.batch import Batch
from cavbench.driving.gym.declaration import Declaration
from cavbench.scenarios import Cell, SeedBlock

STEPS, CPU_S = 30, 1.0
"""Length of an episode that is driven again, and CPU seconds after which a slow environment is left."""
BEFORE = 5
"""Steps of an episode before it."""
CLOSE = 1e-4
"""Observations on [-1, 1] and rewards that differ by less are the same."""
SEEDS = (int(SeedBlock.TUNE), int(SeedBlock.TUNE) + 1)
UNPAIRED = "no score can be repeated, and an attacked episode is not the clean one with an attack"

Track = list[NDArray[np.float64]]
"""[n] observation, reward, progress and the ends of one episode, at its start and after each step."""


def repeats(world: Declaration, cells: Sequence[Cell]) -> list[str]:
    """What makes an episode another one when it is driven again: one line, or none.

    Args:
        world: the world.
        cells: cells that it will be driven in.

    Raises:
        UserError: if the spaces of an environment are not those that the world declares.
    """
    pair = [cells[0], cells[-1]]
    alone = _driven(world, pair[:1], SEEDS[:1], STEPS)[0]
    steps = len(alone) - 1
    name = world.label
    if _differ(alone, _driven(world, pair[:1], SEEDS[:1], steps)[0]):
        return [
            f"an environment of {name} that is reset with the same seed goes on otherwise, so {UNPAIRED}: pass the seed of reset "
            "on, and draw all random numbers from `self.np_random`"
        ]
    if _differ(alone, _driven(world, pair, SEEDS, steps)[0]):
        return [
            f"two environments of {name} that are driven in turn change each other (a global, an attribute of a class, an object "
            f"that is made once), so every score is wrong, and {UNPAIRED}: give each environment its own"
        ]
    if _differ(alone, _driven(world, pair[:1], SEEDS[:1], steps, before=SEEDS[1])[0]):
        return [
            f"an episode of {name} depends on those before it in the same environment (NormalizeObservation and other running "
            f"statistics, a counter), so {UNPAIRED}: reset begins anew, and statistics are fixed"
        ]
    return []


def _driven(
    world: Declaration, cells: Sequence[Cell], seeds: Sequence[int], steps: int, before: int | None = None
) -> list[Track]:
    """The episodes of new environments with these seeds, with the same actions each time.

    Args:
        world: the world.
        cells: a cell for each environment.
        seeds: the seed of each.
        steps: length of an episode.
        before: the seed of an episode that is driven before; None for none.
    """
    kind: ActionType = "discrete" if world.actions else "continuous"
    with closing(Batch(world, cells, kind)) as batch:
        if before is not None:
            _episode(batch, [before] * len(cells), BEFORE)
        return _episode(batch, seeds, steps)


def _episode(batch: Batch, seeds: Sequence[int], steps: int) -> list[Track]:
    generators = [np.random.default_rng(seed) for seed in seeds]
    td = batch.reset(TensorDict({"seed": torch.tensor(seeds)}, batch_size=[len(seeds)]))
    tracks: list[Track] = [[_state(batch, place)] for place in range(len(seeds))]
    end = time.process_time() + CPU_S
    for _ in range(steps):
        if batch.discrete:
            actions = torch.tensor([int(one.integers(len(batch.world.actions))) for one in generators])
        else:
            actions = torch.from_numpy(
                np.stack([one.uniform(-1, 1, len(batch.world.controls)) for one in generators]).astype(np.float32)
            )
        td = batch.step(td.set("action", actions))["next"]
        for place, track in enumerate(tracks):
            track.append(_state(batch, place))
        if td["done"].all() or (steps == STEPS and time.process_time() > end):
            break
    return tracks


def _state(batch: Batch, place: int) -> NDArray[np.float64]:
    ends = [float(batch.flags[name][place, 0]) for name in ("terminated", "truncated", "crashed")]
    numbers = [float(batch.numbers[name][place, 0]) for name in ("reward", "progress")]
    return np.array([*batch.seen[place].reshape(-1), *numbers, *ends])


def _differ(first: Track, second: Track) -> bool:
    """Whether two drives differ as far as both go."""
    count = min(len(first), len(second))
    return not np.allclose(np.stack(first[:count]), np.stack(second[:count]), rtol=0, atol=CLOSE, equal_nan=True)
