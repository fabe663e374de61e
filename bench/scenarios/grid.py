"""Named, versioned grids of scenarios, and blocks of scenario seeds."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

from bench.scenarios.axes import Axes, Cell, Value


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
        name: name on the command line, for instance `standard-v1`; `custom` for one composed there.
        world: name of its world.
        axes: axes of that world.
        values: at least one value for each axis.
        episodes: scenario seeds per cell.
        training_seeds: number of training (or patch) seeds that a run drives if it is not told which.
        first_seed: first scenario seed.

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

    def __post_init__(self) -> None:
        if not 1 <= self.episodes <= MOST_EPISODES:
            raise ValueError(f"episodes must be between 1 and {MOST_EPISODES}, got {self.episodes}")
        if self.training_seeds < 1:
            raise ValueError(f"training_seeds must be at least 1, got {self.training_seeds}")
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

    def with_(self, *, episodes: int | None = None, **values: Sequence[Value]) -> Grid:
        """The grid with other values or another number of episodes; if anything changes, its name becomes `custom`."""
        wanted = self.episodes if episodes is None else episodes
        changed = replace(self, values={**self.values, **values}, episodes=wanted)
        same = changed.episodes == self.episodes and changed.cells() == self.cells()
        return self if same else replace(changed, name="custom")
