"""A plan: all that a run will do, known before it does anything. What comes after takes the plan, not the options."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from cavbench.core import registry
from cavbench.core.device import CPU, resolved
from cavbench.core.pair import Pair
from cavbench.core.track import Track, track_of
from cavbench.errors import short
from cavbench.identity.fingerprint import canonical
from cavbench.records.schema import SEQUENTIAL
from cavbench.run.cost import Cost, cost_of
from cavbench.run.gates import Gates
from cavbench.run.networks import Weights, hashes
from cavbench.run.options import EXECUTORS, half_of_memory
from cavbench.run.task import Limits, Task
from cavbench.run.unit import Unit
from cavbench.scenarios import Cell, Grid

SCENARIOS = 10
"""Scenarios of each cell in a round."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A run: each pair, its clean control and its baselines, on every cell and block of seeds, with every training seed.

    Args:
        pairs: pairs to evaluate.
        grid: cells and scenario seeds.
        seeds: training seeds of the victims, and seeds of the patches.
        executor: back end that carries out the tasks, a name in `cavbench.run.options.EXECUTORS`.
        workers: number of worker processes; results do not depend on it. None takes every core, of this machine or of the
            Ray cluster.
        ray_address: of the Ray cluster: `local` starts one on this machine, `auto` finds the running one.
        out: results folder.
        record: episodes to record in every cell of each pair; None records one episode of the first cell.
        reference: whether to run the baselines of the pairs, too.
        skipped: members of suites that do not fit a victim, one line each.
        broken: plug-ins that were chosen but cannot be used, one line each.
        shard: (3, 10) drives the third of ten equal parts of the units.
        unit_timeout: seconds that a task may take; 0 for no limit.
        unit_memory: GB of memory that a worker process may use; 0 for no limit.
        racing: the pairs that race (`cavbench.run.racing`), by their `id`.
        device: where victims compute: `auto` is a GPU if there is one, and becomes `cpu` or `cuda` here.
        until: half the width of the interval at which a row has enough scenarios (`cavbench.run.rounds`); None drives them all.
        gates: what it must reach to pass.
        log: kind of log of its scores (`cavbench.run.logs`); None for none.
        words: the options that repeat the run, by key (`cavbench.run.config_file`); empty for a run from Python.

    Raises:
        ValueError: if a number is out of range.
    """

    pairs: tuple[Pair, ...]
    grid: Grid
    seeds: tuple[int, ...] = (0, 1, 2)
    executor: str = "processes"
    workers: int | None = None
    ray_address: str = "local"
    out: Path = Path("results")
    record: int | None = None
    reference: bool = True
    skipped: tuple[str, ...] = ()
    broken: tuple[str, ...] = ()
    shard: tuple[int, int] = (1, 1)
    unit_timeout: float = 3600.0
    unit_memory: float = field(default_factory=half_of_memory)
    until: float | None = None
    racing: frozenset[str] = frozenset()
    device: str = CPU
    gates: Gates = field(default_factory=Gates)
    log: str | None = None
    words: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_seeds(self.seeds)
        if self.executor not in EXECUTORS:
            raise ValueError(registry.unknown(f"executor {self.executor!r}", self.executor, EXECUTORS))
        object.__setattr__(self, "device", resolved(self.device, self.executor))
        if self.workers is not None and self.workers < 1:
            raise ValueError(f"workers must be at least 1, got {self.workers}")
        for name in ("unit_timeout", "unit_memory"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be a number of at least 0 (0: no limit), got {getattr(self, name):g}")
        if self.record is not None and not 0 <= self.record <= self.grid.episodes:
            raise ValueError(f"record must be between 0 and the {self.grid.episodes} episodes, got {self.record}")
        if self.until is not None:
            self._check_until(self.until)
        if self.racing and (self.until is not None or self.shard != (1, 1)):
            raise ValueError("a race looks at all units of its pilot: with until or shard, race=true cannot be")

    def _check_until(self, until: float) -> None:
        if not 0.001 <= until < 0.5:
            raise ValueError(f"until must be between 0.001 and 0.5 (half the width of the interval), got {until:g}")
        if self.shard != (1, 1):
            raise ValueError("until looks at all units of a row: leave out shard, or leave out until")
        for pair in self.pairs:
            if not pair.world.component.redraws:
                raise ValueError(f"world {pair.world.name!r} has a fixed set of scenarios: leave out until")

    @property
    def track(self) -> Track:
        """The track of its pairs, which is one."""
        return track_of(self.pairs[0])

    @property
    def limits(self) -> Limits:
        """What each task may use."""
        return Limits(seconds=self.unit_timeout, memory_gb=self.unit_memory)

    @cached_property
    def baselines(self) -> tuple[Pair, ...]:
        """The distinct baselines of the pairs; none without `reference`."""
        every = [other for pair in self.pairs for other in track_of(pair).baselines(pair)] if self.reference else []
        return tuple({pair.id: pair for pair in every}.values())

    @cached_property
    def driven(self) -> tuple[Pair, ...]:
        """All distinct pairs that are driven: the requested ones, their clean controls, and the baselines."""
        clean = [pair.clean() for pair in self.pairs]
        return tuple({pair.id: pair for pair in (*self.pairs, *clean, *self.baselines)}.values())

    @cached_property
    def loadings(self) -> tuple[Task, ...]:
        """The tasks that load the networks of all pairs, each once. The first of each world also asks it about the cells."""
        found: dict[str, Task] = {}
        asked: set[str] = set()
        cells = self.grid.cells()
        for pair in self.driven:
            for seed in self._training_seeds(pair):
                world = canonical([pair.world.name, pair.world.params])
                unit = self._unit(pair, seed)
                task = Task(
                    unit=unit, step="load", cells=cells, episodes=self.grid.episodes, asks_world=world not in asked
                )
                found.setdefault(unit.networks, task)
                asked.add(world)
        return tuple(found.values())

    @cached_property
    def rounds(self) -> tuple[Plan, ...]:
        """The rounds in which its scenarios are driven, each a plan; the plan itself if it has no `until`."""
        if self.until is None:
            return (self,)
        grid = self.grid
        first = range(0, grid.episodes, SCENARIOS)
        parts = [(grid.first_seed + start, min(SCENARIOS, grid.episodes - start)) for start in first]
        grids = [replace(grid, name=SEQUENTIAL, first_seed=seed, episodes=count) for seed, count in parts]
        return tuple(replace(self, grid=part) for part in grids)

    @cached_property
    def cost(self) -> Cost:
        """What it will cost, known before it does anything."""
        return cost_of(self)

    def units(self, weights: Weights | None = None) -> list[Unit]:
        """The distinct units, or those of the shard, whose networks could be loaded.

        Every shard has every `shards`th unit, whatever could be loaded where it is driven.

        Args:
            weights: the hashes of the networks; None loads all of them here.

        Raises:
            UserError: if a victim or an adversary cannot be loaded here.
        """
        if weights is None:
            weights = {task.unit.networks: hashes(task.unit) for task in self.loadings}
        units: list[Unit] = []
        place = 0
        own, shards = self.shard
        for pair in self.driven:
            for seed in self._training_seeds(pair):
                parts = list(itertools.product(self.grid.blocks(), self.cells(pair)))
                mine = [part for number, part in enumerate(parts, place) if number % shards == own - 1]
                place += len(parts)
                first = self._unit(pair, seed)
                if (loaded := weights.get(first.networks)) is not None:
                    first = replace(first, weights_sha256=loaded[0], adversary_sha256=loaded[1])
                    units += [replace(first, cell=cell, seeds=block) for block, cell in mine]
        return units

    def first_units(self) -> list[Unit]:
        """A unit of each pair, whose networks are not loaded: it says which code the pair is driven by."""
        return [self._unit(pair, self._training_seeds(pair)[0]) for pair in self.driven]

    def _unit(self, pair: Pair, training_seed: int) -> Unit:
        """A unit of a pair, on the whole first cell, whose networks are not loaded."""
        return Unit(
            pair=pair,
            cell=self.grid.cells()[0],
            training_seed=training_seed,
            seeds=self.grid.seeds(),
            weights_sha256="",
            sequential=self.grid.name == SEQUENTIAL,
            device=self.device,
        )

    def can_drive(self, weights: Weights) -> bool:
        """Whether a requested pair has networks that could be loaded."""
        return any(
            self._unit(pair, seed).networks in weights for pair in self.pairs for seed in self._training_seeds(pair)
        )

    def cells(self, pair: Pair) -> list[Cell]:
        """The cells that a pair drives; for a victim that ignores its input, without duplicates along perceptual axes."""
        cells = self.grid.cells()
        if pair.victim.component.sees:
            return list(cells)
        return list(dict.fromkeys(self.grid.axes.unperceived(cell) for cell in cells))

    def recorded(self, units: Iterable[Unit]) -> dict[str, Sequence[int]]:
        """The scenario seeds to record, by fingerprint of the unit: of the requested pairs, with their first training seed."""
        if self.record == 0:
            return {}
        requested = {pair.id for pair in self.pairs}
        first_units: dict[str, Unit] = {}
        found: dict[str, Sequence[int]] = {}
        for unit in units:
            first = first_units.setdefault(unit.pair.id, unit)
            first_round = unit.seeds.start == self.grid.first_seed
            wanted = first_round and unit.pair.id in requested and unit.training_seed == first.training_seed
            if wanted and (self.record is not None or unit is first):
                found[unit.fingerprint] = unit.seeds[: 1 if self.record is None else self.record]
        return found

    def _training_seeds(self, pair: Pair) -> tuple[int, ...]:
        return self.seeds if pair.is_seeded else (0,)


def check_seeds(seeds: tuple[int, ...]) -> None:
    """Raise ValueError unless there is at least one training seed, and all are distinct and not negative."""
    if not seeds or min(seeds) < 0 or len(set(seeds)) < len(seeds):
        raise ValueError(
            f"seeds must be distinct whole numbers of at least 0, got {short(','.join(map(str, seeds))) or 'none'}"
        )
