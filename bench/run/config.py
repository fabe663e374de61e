"""From the options as typed to the plan of a run, or to what is trained."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cavbench.core import registry, sets
from cavbench.core.options import Options, configured
from cavbench.core.pair import Chosen, Pair, check_track
from cavbench.core.registry import KINDS, Kind
from cavbench.core.suites import combined, racing
from cavbench.errors import UserError, short
from cavbench.run import config_file, logs
from cavbench.run.gates import Gates
from cavbench.run.options import RunOptions, TrainOptions
from cavbench.run.plan import Plan, check_seeds
from cavbench.scenarios import Grid


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
        log: kind of log (`cavbench.run.logs`); None for none.
    """

    victim: Chosen[Any]
    defense: Chosen[Any]
    attack: Chosen[Any]
    world: Chosen[Any]
    seeds: tuple[int, ...] = (0,)
    out: Path | None = None
    log: str | None = None

    def __post_init__(self) -> None:
        check_seeds(self.seeds)
        check_track(self.victim, self.defense, self.attack, self.world)
        # A pair checks that the attack fits the victim. What the attack needs is allowed where it is trained.
        model, attack = self.victim.component.threat, self.attack.component
        threat = model(**sets.read(model, list(attack.forges)))
        Pair(attack=self.attack, defense=self.defense, victim=self.victim, world=self.world, threat=threat)

    @property
    def trained(self) -> Chosen[Any]:
        """The component to train: the attack if there is one, else the defence if there is one, else the victim."""
        return next((part for part in (self.attack, self.defense) if part.name != "none"), self.victim)


Start = Callable[[str, Sequence[str]], None]
"""Is told that the options are understood: the executor, and the modules of the built-in components."""


def plan_of(words: Sequence[str], start: Start = lambda executor, modules: None) -> Plan:
    """The plan of `bench run` with these words.

    Args:
        words: options, each `key=value`.
        start: called with the executor and the modules of the built-in components when all names are known, before the first
            component is imported, which takes seconds.

    Raises:
        UserError: if an option cannot be parsed or is not allowed.
    """
    words = config_file.expanded(words)
    axes = dict.fromkeys(axis for grid in registry.all_grids() for axis in grid.axes)
    given = Options(words, kinds=KINDS, settings=RunOptions, axes=list(axes))
    given.check_names()
    given.check_outlines()
    settings = given.settings()
    start(settings["executor"], given.modules())
    if settings["executor"] != "ray" and any(key.startswith("ray.") for key in given.values):
        raise UserError("ray.address is of executor=ray: add executor=ray, or leave it out")
    with _one_line():
        standard = _grid(given, settings["grid"])
        grid = standard.with_(episodes=settings["episodes"], **given.cell_values(standard.axes))
        pairs, skipped = _pairs(given)
        return Plan(
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
            racing=_racing(settings, pairs, given),
            device=settings["device"],
            gates=_gates(settings),
            log=_log(settings["log"]),
            words=_repeating(words, given, standard, settings["seeds"]),
        )


def _racing(settings: Mapping[str, Any], pairs: Sequence[Pair], given: Options) -> frozenset[str]:
    """The pairs that race: by default those of suites, where all their units are in one run."""
    alone = settings["until"] is None and settings["shard"] == "1/1"
    wanted = alone if settings["race"] is None else settings["race"]
    return racing(pairs, given.chosen("attack"), given.suites) if wanted else frozenset()


def _gates(settings: Mapping[str, Any]) -> Gates:
    """The gates of a run."""
    paths = {name: Path(settings[name]).expanduser() for name in ("against", "junit") if settings[name]}
    return Gates(fail_below=settings["fail_below"], **paths)


def _repeating(words: Sequence[str], given: Options, grid: Grid, seeds: Sequence[int] | None) -> dict[str, str]:
    """The words of a run by key, with the names and the grid that were not typed: so they repeat it where defaults differ."""
    typed = {key: value for key, _, value in (word.partition("=") for word in words)}
    found: dict[str, str] = {kind: ",".join(dict.fromkeys(one.name for one in given.chosen(kind))) for kind in KINDS}
    # A suite is written with its version.
    found["attack"] = ",".join([*filter(None, [found["attack"]]), *(suite.name for suite in given.suites)])
    found["grid"] = grid.name
    found["seeds"] = ",".join(map(str, range(grid.training_seeds) if seeds is None else seeds))
    return found | {key: value for key, value in typed.items() if key not in (*KINDS, *HOW)}


HOW = ("executor", "workers", "ray.address", "unit_timeout", "unit_memory", "fail_below", "against", "junit", "log")
"""Options that decide no record: how a run is carried out, and what is said of it."""


def _shard(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d{0,8})/([1-9]\d{0,8})", text)
    if match is None or int(match[1]) > int(match[2]):
        raise UserError(f"shard must be PART/PARTS, for instance shard=3/10, got {short(text)}")
    return int(match[1]), int(match[2])


def _pairs(given: Options) -> tuple[list[Pair], list[str]]:
    """Every combination of the chosen components and threat models, and the members of suites that are skipped."""
    attacks = given.chosen("attack")
    sets = [key for key in given.values if re.fullmatch(r"threat\.\w+\.\w+", key)]
    if sets and all(one.name == "none" for one in attacks):
        raise UserError(
            f"attack=none leaves out {sets[0]}, as runs without an attack stay clean: name an attack, or type attack=noise "
            "threat.budget=0, which changes nothing else"
        )
    choices: list[Sequence[Any]] = [given.chosen(kind) for kind in KINDS if kind != "attack"]
    names = ("defense", "victim", "world", "threat")
    others = [dict(zip(names, parts, strict=True)) for parts in itertools.product(*choices, given.threats())]
    return combined(attacks, given.suites, others)


def _grid(given: Options, name: str | None) -> Grid:
    """The grid of this name, or the default grid of the world.

    Raises:
        UserError: if there is no such grid, or several worlds are chosen.
    """
    worlds = given.chosen("world")
    first = worlds[0]
    own = first.component.own_grid()
    # Those of one name may have other axes, or other values on them.
    if any((world.name, world.component.own_grid()) != (first.name, own) for world in worlds):
        raise UserError(f"a run uses one world, got {' and '.join(map(str, worlds))}: start one run for each")
    return grid_of(first, name)


def grid_of(chosen: Chosen[Any], name: str | None) -> Grid:
    """The grid of this name of a world, or its default one.

    Raises:
        UserError: if there is no such grid.
    """
    world, own = chosen.name, chosen.component.own_grid()
    if own is not None:
        if name not in (None, own.name):
            raise UserError(
                f"grid {name!r} is none of the world {world!r}, whose cells follow from its parameters: leave out grid"
            )
        return own
    name = name or chosen.component.grid
    known = [grid.name for grid in registry.grids(world)]
    if name not in known:
        if name in registry.entries(registry.GRIDS):
            registry.grid(name)  # raises the reason if the grid is broken
        raise UserError(registry.unknown(f"grid {name!r} of the world {world!r}", name, known))
    return registry.grid(name)


def training_of(words: Sequence[str], start: Start = lambda executor, modules: None) -> TrainConfig:
    """What `bench train` trains with these words; arguments as in `plan_of`.

    Raises:
        UserError: if an option cannot be parsed or is not allowed.
    """
    given = Options(words, kinds=KINDS, settings=TrainOptions)
    given.check_names()
    given.check_outlines()
    start("", ())
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
            log=_log(settings["log"]),
        )


def _log(kind: str | None) -> str | None:
    """The kind of log, refused before anything is driven if it cannot be written."""
    if kind is not None:
        logs.check(kind)
    return kind


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
