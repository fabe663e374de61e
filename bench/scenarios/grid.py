"""Named, versioned grids of scenarios, and the blocks that scenario seeds are taken from."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

from bench.scenarios.axes import Axes, Cell, Value


class SeedBlock(IntEnum):
    """Where each use of scenario seeds begins. Seeds that select or tune are never the seeds that are reported."""

    REPORT = 1_000_000
    SELECT = 2_000_000
    TUNE = 3_000_000
    TRAIN = 10_000_000


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A named, versioned list of scenarios in a world: every combination of values, with `episodes` seeds a cell.

    Args:
        name: as on the command line, for instance `standard-v1`; `custom` for one that was put together there.
        world: name of the world that it is of.
        axes: of that world.
        values: of each axis, at least one.
        episodes: scenario seeds a cell.
        first_seed: the first of them.

    Raises:
        ValueError: in one line, if a value is not allowed or missing.
    """

    name: str
    world: str
    axes: Axes
    values: Mapping[str, Sequence[Value]]
    episodes: int
    first_seed: int = SeedBlock.REPORT

    def __post_init__(self) -> None:
        if not 1 <= self.episodes <= SeedBlock.SELECT - SeedBlock.REPORT:
            raise ValueError(f"episodes must be between 1 and 1000000, got {self.episodes}")
        for name in self.axes:
            if not self.values.get(name):
                raise ValueError(f"a grid needs at least one value of {name}")
        self.cells()

    def cells(self) -> tuple[Cell, ...]:
        """The cells of the grid in the order of tables, each once."""
        combined = itertools.product(*(self.values[name] for name in self.axes))
        cells = {self.axes.cell(**dict(zip(self.axes, values, strict=True))) for values in combined}
        return tuple(sorted(cells, key=self.axes.place))

    def seeds(self) -> range:
        """The scenario seeds of every cell."""
        return range(self.first_seed, self.first_seed + self.episodes)

    def with_(self, *, episodes: int | None = None, **values: Sequence[Value]) -> Grid:
        """The grid with other values or another number of episodes; its name then says that it is none of the named ones."""
        wanted = self.episodes if episodes is None else episodes
        changed = replace(self, values={**self.values, **values}, episodes=wanted)
        same = changed.episodes == self.episodes and changed.cells() == self.cells()
        return self if same else replace(changed, name="custom")
