"""Typed, frozen configurations of runs and trainings, from `key=value` options."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cavbench.core import registry
from cavbench.core.device import CPU, resolved
from cavbench.core.options import Options, configured
from cavbench.core.pair import Chosen, Pair, check_track
from cavbench.core.registry import KINDS, Kind
from cavbench.core.suites import Suite
from cavbench.errors import UserError, short
from cavbench.run.executors import EXECUTORS
from cavbench.run.options import RunOptions, TrainOptions, half_of_memory
from cavbench.scenarios import Grid


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """A run: every pair on every cell of the grid with every training seed.

    Args:
        pairs: pairs to evaluate.
        grid: cells and scenario seeds.
        seeds: training seeds of the victims, and seeds of the patches.
        executor: back end that carries out the work, a name in `cavbench.run.executors.EXECUTORS`.
        workers: number of worker processes; results do not depend on it. None takes every core, of this machine or of the
            Ray cluster.
        ray_address: of the Ray cluster: `local` starts one on this machine, `auto` finds the running one.
        out: results folder.
        record: episodes to record in every cell of each pair; None records one episode of the first cell.
        reference: whether to run the baselines of the pairs, too.
        skipped: members of suites that do not fit a victim, one line each.
        broken: plug-ins that were chosen but cannot be used, one line each.
        shard: (3, 10) drives the third of ten equal parts of the units.
        unit_timeout: seconds that a unit or preparation may take; 0 for no limit.
        unit_memory: GB of memory that a worker process may use; 0 for no limit.
        device: where victims compute: `auto` is a GPU if there is one, and becomes `cpu` or `cuda` here.
        until: half the width of the interval at which a row has enough scenarios (`cavbench.run.rounds`); None drives them all.

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
    device: str = CPU

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

    def _check_until(self, until: float) -> None:
        if not 0.001 <= until < 0.5:
            raise ValueError(f"until must be between 0.001 and 0.5 (half the width of the interval), got {until:g}")
        if self.shard != (1, 1):
            raise ValueError("until looks at all units of a row: leave out shard, or leave out until")
        for pair in self.pairs:
            if not pair.world.component.redraws:
                raise ValueError(f"world {pair.world.name!r} has a fixed set of scenarios: leave out until")


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A training: one network per training seed.

    Args:
        victim: victim to train.
        defense: defence to train it with; `none` trains the victim itself.
        attack: attack to train against the victim and its defence; `none` trains these.
        world: world to train in.
        seeds: training seeds.
        out: zoo to save to; None for the user's zoo.
    """

    victim: Chosen[Any]
    defense: Chosen[Any]
    attack: Chosen[Any]
    world: Chosen[Any]
    seeds: tuple[int, ...] = (0,)
    out: Path | None = None

    def __post_init__(self) -> None:
        check_seeds(self.seeds)
        check_track(self.victim, self.defense, self.attack, self.world)
        # A pair checks that the attack fits the victim.
        threat = self.victim.component.threat()
        Pair(attack=self.attack, defense=self.defense, victim=self.victim, world=self.world, threat=threat)

    @property
    def trained(self) -> Chosen[Any]:
        """The component to train: the attack if there is one, else the defence if there is one, else the victim."""
        return next((part for part in (self.attack, self.defense) if part.name != "none"), self.victim)


def check_seeds(seeds: tuple[int, ...]) -> None:
    """Raise ValueError unless there is at least one training seed, and all are distinct and not negative."""
    if not seeds or min(seeds) < 0 or len(set(seeds)) < len(seeds):
        raise ValueError(
            f"seeds must be distinct whole numbers of at least 0, got {short(','.join(map(str, seeds))) or 'none'}"
        )


def run_config(words: Sequence[str]) -> RunConfig:
    """The configuration of `bench run` with these options.

    Raises:
        UserError: if an option cannot be parsed or is not allowed.
    """
    axes = dict.fromkeys(axis for grid in registry.all_grids() for axis in grid.axes)
    given = Options(words, kinds=KINDS, settings=RunOptions, axes=list(axes))
    settings = given.settings()
    if settings["executor"] != "ray" and any(word.startswith("ray.") for word in words):
        raise UserError("ray.address is of executor=ray: add executor=ray, or leave it out")
    with _one_line():
        standard = _grid(given, settings["grid"])
        grid = standard.with_(episodes=settings["episodes"], **given.cell_values(standard.axes))
        pairs, skipped = _pairs(given)
        return RunConfig(
            pairs=tuple(pairs),
            grid=grid,
            seeds=tuple(range(standard.training_seeds) if settings["seeds"] is None else settings["seeds"]),
            executor=settings["executor"],
            workers=settings["workers"],
            ray_address=settings["ray"]["address"],
            out=Path(settings["out"]).expanduser(),
            record=settings["record"],
            reference=settings["reference"],
            skipped=tuple(skipped),
            broken=tuple(given.broken.values()),
            shard=_shard(settings["shard"]),
            unit_timeout=settings["unit_timeout"],
            unit_memory=settings["unit_memory"],
            until=settings["until"],
            device=settings["device"],
        )


def _shard(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d{0,8})/([1-9]\d{0,8})", text)
    if match is None or int(match[1]) > int(match[2]):
        raise UserError(f"shard must be PART/PARTS, for instance shard=3/10, got {short(text)}")
    return int(match[1]), int(match[2])


def combined(
    attacks: Sequence[Chosen[Any]],
    suites: Sequence[Suite],
    others: Sequence[Mapping[str, Any]],
) -> tuple[list[Pair], list[str]]:
    """The pairs of every attack, and of every member of the suites, with every combination of the other parts.

    Args:
        attacks: attacks chosen by name.
        suites: suites of attacks.
        others: combinations of `defense`, `victim`, `world` and `threat`, as keywords of `Pair`.

    Returns:
        The distinct pairs, and why members of suites are skipped, one line each.

    Raises:
        UserError: if an attack that was chosen by its name does not fit, or no member of a suite does.
    """
    pairs, skipped = [], []
    for parts in others:
        own = [Pair(attack=attack, **parts) for attack in attacks]
        pairs += [pair.clean() if pair.is_clean else pair for pair in own]
        for suite in suites:
            made, left = suite.pairs(**parts)
            pairs += made
            skipped += left
    if not pairs:
        raise UserError(skipped[0] if skipped else f"no member of {suites[0].name} is meant for the victim")
    return list({pair.id: pair for pair in pairs}.values()), list(dict.fromkeys(skipped))


def _pairs(given: Options) -> tuple[list[Pair], list[str]]:
    """Every combination of the chosen components and threat models, and the members of suites that are skipped."""
    attacks = given.chosen("attack")
    choices: list[Sequence[Any]] = [given.chosen(kind) for kind in KINDS if kind != "attack"]
    names = ("defense", "victim", "world", "threat")
    others = [dict(zip(names, parts, strict=True)) for parts in itertools.product(*choices, given.threats())]
    return combined(attacks, given.suites, others)


def _grid(given: Options, name: str | None) -> Grid:
    """The grid of this name, or the default grid of the world.

    Raises:
        UserError: if there is no such grid, or several worlds are chosen.
    """
    worlds = {world.name: world.component for world in given.chosen("world")}
    if len(worlds) > 1:
        raise UserError(f"a run uses one world, got {' and '.join(worlds)}: start one run for each")
    ((world_name, world),) = worlds.items()
    return grid_of(world_name, name or world.grid)


def grid_of(world: str, name: str) -> Grid:
    """The grid of this name of a world.

    Raises:
        UserError: if there is no such grid.
    """
    known = [grid.name for grid in registry.grids(world)]
    if name not in known:
        if name in registry.entries(registry.GRIDS):
            registry.grid(name)  # raises the reason if the grid is broken
        raise UserError(registry.unknown(f"grid {name!r} of the world {world!r}", name, known))
    return registry.grid(name)


def train_config(words: Sequence[str]) -> TrainConfig:
    """The configuration of `bench train` with these options; `seed` is an alias of `seeds`.

    Raises:
        UserError: if an option cannot be parsed or is not allowed.
    """
    words = [f"seeds={word.removeprefix('seed=')}" if word.startswith("seed=") else word for word in words]
    given = Options(words, kinds=("attack", "defense", "victim", "world"), settings=TrainOptions)
    settings = given.settings()
    one: dict[Kind, Chosen[Any]] = {}
    for kind in given.kinds:
        choices = given.chosen(kind)
        if len(choices) > 1:
            raise UserError(
                f"bench train trains one network per seed, not {len(choices)}: give one {kind} and one set of parameters"
            )
        one[kind] = choices[0]
    with _one_line():
        return TrainConfig(
            victim=one["victim"],
            defense=one["defense"],
            attack=one["attack"],
            world=one["world"],
            seeds=tuple(settings["seeds"]),
            out=Path(settings["out"]).expanduser() if settings["out"] else None,
        )


def component(kind: Kind, name: str, values: Mapping[str, str]) -> Any:
    """A component by name, with parameters parsed as on the command line: `component("attack", "pgd", {"steps": "3"})`.

    Raises:
        UserError: if a value cannot be parsed or is not allowed.
    """
    return configured(kind, name, values).component


@contextmanager
def _one_line() -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise UserError(str(error).splitlines()[0]) from error
