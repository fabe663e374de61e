"""What a run is, in frozen and typed configurations, made from `key=value` words."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.errors import UserError
from bench.plugins import registry
from bench.plugins.options import Options, configured
from bench.plugins.pair import Chosen, Pair, check_track
from bench.plugins.registry import KINDS, Kind
from bench.run.executors import EXECUTORS
from bench.scenarios import Grid


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """A run: every pair on every cell of the grid with every training seed.

    Args:
        pairs: what is run.
        grid: the cells and the scenario seeds.
        seeds: training seeds of the victims; of detectors also the seeds of the patches.
        executor: the back end that carries out the work, a name in `bench.run.executors.EXECUTORS`.
        workers: worker processes; results do not depend on their number.
        out: results folder.
        record: episodes to record of every cell of each pair; None records one, of the first cell.
        reference: whether the reference drivers, or the reference patches, are run too.

    Raises:
        ValueError: if a number is out of range.
    """

    pairs: tuple[Pair, ...]
    grid: Grid
    seeds: tuple[int, ...] = (0, 1, 2)
    executor: str = "processes"
    workers: int = field(default_factory=lambda: cores())
    out: Path = Path("results")
    record: int | None = None
    reference: bool = True

    def __post_init__(self) -> None:
        check_seeds(self.seeds)
        if self.executor not in EXECUTORS:
            raise ValueError(registry.unknown(f"executor {self.executor!r}", self.executor, EXECUTORS))
        if self.workers < 1:
            raise ValueError(f"workers must be at least 1, got {self.workers}")
        if self.record is not None and not 0 <= self.record <= self.grid.episodes:
            raise ValueError(f"record must be between 0 and the {self.grid.episodes} episodes, got {self.record}")


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A training: one policy a training seed.

    Args:
        victim: what is trained.
        defense: how it is hardened; `none` trains the victim itself.
        world: where it practises.
        seeds: training seeds.
        out: the zoo to save to; None is the user's own.
    """

    victim: Chosen[Any]
    defense: Chosen[Any]
    world: Chosen[Any]
    seeds: tuple[int, ...] = (0,)
    out: Path | None = None

    def __post_init__(self) -> None:
        check_seeds(self.seeds)
        check_track(self.victim, self.defense, self.world)


def check_seeds(seeds: tuple[int, ...]) -> None:
    """Raise ValueError unless there is at least one training seed, none negative and none twice."""
    if not seeds or min(seeds) < 0 or len(set(seeds)) < len(seeds):
        raise ValueError(f"seeds must be different numbers of at least 0, got {','.join(map(str, seeds)) or 'none'}")


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass
class RunOptions:
    """The options of `bench run` that choose no component and no cell, with their types and defaults."""

    grid: str | None = None
    episodes: int | None = None
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    executor: str = "processes"
    workers: int = field(default_factory=cores)
    out: str = "results"
    record: int | None = None
    reference: bool = True


@dataclass
class TrainOptions:
    """The options of `bench train` that choose no component."""

    seeds: list[int] = field(default_factory=lambda: [0])
    out: str | None = None


def run_config(words: Sequence[str]) -> RunConfig:
    """The configuration of `bench run WORDS`.

    Raises:
        UserError: for anything that cannot be read or is not allowed, in one line.
    """
    axes = dict.fromkeys(axis for grid in registry.all_grids() for axis in grid.axes)
    given = Options(words, kinds=KINDS, settings=RunOptions, axes=list(axes))
    settings = given.settings()
    with _one_line():
        standard = _grid(given, settings["grid"])
        grid = standard.with_(episodes=settings["episodes"], **given.cell_values(standard.axes))
        choices: list[Sequence[Any]] = [given.chosen(kind) for kind in KINDS]
        pairs = [
            Pair(attack=attack, defense=defense, victim=victim, world=world, threat=threat)
            for attack, defense, victim, world, threat in itertools.product(*choices, given.threats())
        ]
        pairs = [pair.clean() if pair.is_clean else pair for pair in pairs]
        return RunConfig(
            pairs=tuple({pair.id: pair for pair in pairs}.values()),
            grid=grid,
            seeds=tuple(settings["seeds"]),
            executor=settings["executor"],
            workers=settings["workers"],
            out=Path(settings["out"]).expanduser(),
            record=settings["record"],
            reference=settings["reference"],
        )


def _grid(given: Options, name: str | None) -> Grid:
    """The grid of this name, or the world's own.

    Raises:
        UserError: if there is none of this name, or if it is of another world.
    """
    worlds = {world.name: world.component for world in given.chosen("world")}
    if len(worlds) > 1:
        raise UserError(f"one run drives one world, got {' and '.join(worlds)}: run one after the other")
    ((own, world),) = worlds.items()
    known = [grid.name for grid in registry.grids(own)]
    wanted = name or world.grid
    if wanted not in known:
        if wanted in registry.entries(registry.GRIDS):
            registry.grid(wanted)  # says why, if it is broken
        raise UserError(registry.unknown(f"grid {wanted!r} of the world {own!r}", wanted, known))
    return registry.grid(wanted)


def train_config(words: Sequence[str]) -> TrainConfig:
    """The configuration of `bench train WORDS`; `seed` is another word for `seeds`.

    Raises:
        UserError: for anything that cannot be read or is not allowed, in one line.
    """
    words = [f"seeds={word.removeprefix('seed=')}" if word.startswith("seed=") else word for word in words]
    given = Options(words, kinds=("defense", "victim", "world"), settings=TrainOptions)
    settings = given.settings()
    one: dict[Kind, Chosen[Any]] = {}
    for kind in given.kinds:
        found = given.chosen(kind)
        if len(found) > 1:
            raise UserError(
                f"bench train trains one policy a seed, not {len(found)}: give one {kind} and one set of parameters"
            )
        one[kind] = found[0]
    with _one_line():
        return TrainConfig(
            victim=one["victim"],
            defense=one["defense"],
            world=one["world"],
            seeds=tuple(settings["seeds"]),
            out=Path(settings["out"]).expanduser() if settings["out"] else None,
        )


def component(kind: Kind, name: str, values: Mapping[str, str]) -> Any:
    """A component by name, its parameters read as on the command line: `component("attack", "pgd", {"steps": "3"})`.

    Raises:
        UserError: for anything that cannot be read or is not allowed, in one line.
    """
    return configured(kind, name, values).component


@contextmanager
def _one_line() -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise UserError(str(error).splitlines()[0]) from error
