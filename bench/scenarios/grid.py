"""Named, versioned grids of scenarios, and blocks of scenario seeds."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

from cavbench.scenarios.axes import Axes, Cell, Value


class SeedBlock(IntEnum):
    """First scenario seed of each use. Seeds for selection or tuning are never reported; those of an audit are drawn by it."""

    REPORT = 1_000_000
    SELECT = 2_000_000
    TUNE = 3_000_000
    TRAIN = 10_000_000
    AUDIT = 2**40


MOST_EPISODES = 10_000
"""Most episodes of a cell: they are one batch in memory, and a unit of work that is kept or lost as a whole."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A named, versioned set of scenarios in a world: all combinations of values, with `episodes` seeds per cell.

    Args:
        name: name on the command line, for instance `standard-v2`; `custom` for one composed there.
        world: name of its world.
        axes: axes of that world.
        values: at least one value for each axis.
        episodes: scenario seeds per cell.
        training_seeds: number of training (or patch) seeds that a run drives if it is not told which.
        first_seed: first scenario seed.
        block: scenario seeds in a unit of work; 0 for all. A run drives the first block of every cell before the second of any:
            one that ends early has complete blocks.

    Raises:
        ValueError: in one line, if a value is missing or not allowed.
    """

    name: str
    world: str
    axes: Axes
    values: Mapping[str, Sequence[Value]]
    episodes: int
    training_seeds: int = 3
    first_seed: int = SeedBlock.REPORT
    block: int = 0

    def __post_init__(self) -> None:
        if not 1 <= self.episodes <= MOST_EPISODES:
            raise ValueError(f"episodes must be between 1 and {MOST_EPISODES}, got {self.episodes}")
        if self.training_seeds < 1:
            raise ValueError(f"training_seeds must be at least 1, got {self.training_seeds}")
        if self.block < 0:
            raise ValueError(f"block must be at least 0 (0: all episodes), got {self.block}")
        for name in self.axes:
            if not self.values.get(name):
                raise ValueError(f"a grid needs at least one value for {name}")
        self.cells()

    def cells(self) -> tuple[Cell, ...]:
        """The distinct cells of the grid, in the order of tables."""
        combined = itertools.product(*(self.values[name] for name in self.axes))
        cells = {self.axes.cell(**dict(zip(self.axes, values, strict=True))) for values in combined}
        return tuple(sorted(cells, key=self.axes.place))

    def seeds(self) -> range:
        """The scenario seeds of every cell."""
        return range(self.first_seed, self.first_seed + self.episodes)

    def blocks(self) -> tuple[range, ...]:
        """The scenario seeds of every cell, in parts of `block`."""
        seeds, size = self.seeds(), self.block or self.episodes
        return tuple(seeds[start : start + size] for start in range(0, len(seeds), size))

    def with_(self, *, episodes: int | None = None, **values: Sequence[Value]) -> Grid:
        """The grid with other values or another number of episodes.

        It keeps its name if it has the same cells and whole blocks of the same episodes; otherwise its name becomes `custom`. Any
        other number of episodes is one block.
        """
        wanted = self.episodes if episodes is None else episodes
        changed = replace(self, values={**self.values, **values}, episodes=wanted)
        own, others = self.blocks(), changed.blocks()
        if others != own[: len(others)]:
            return replace(changed, name="custom", block=0)
        return changed if changed.cells() == self.cells() else replace(changed, name="custom")
