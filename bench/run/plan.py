"""A run as units of work: every pair, its clean control and what it is held against, on every cell of the grid."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace

from bench.driving.contracts import DrivingVictim
from bench.plugins import registry
from bench.plugins.contracts import REFERENCE_PATCHES
from bench.plugins.fingerprint import canonical
from bench.plugins.pair import UNATTACKED, Pair, choose
from bench.plugins.parameters import parameters
from bench.run.config import RunConfig
from bench.run.unit import Unit
from bench.scenarios.grid import Cell

REFERENCES = ("blind", "random", "idm")
"""The drivers that every victim at the wheel is held against."""


def plan(config: RunConfig) -> list[Unit]:
    """Every unit of a run, each once: the pairs, their clean controls and, if asked for, the references.

    Loads every victim once, so that one that is missing is refused before any work.

    Raises:
        UserError: if one cannot be loaded.
    """
    clean = [pair.clean() for pair in config.pairs]
    reference = [other for pair in config.pairs for other in references(pair)] if config.reference else []
    pairs = {pair.id: pair for pair in (*config.pairs, *clean, *reference)}
    weights: dict[str, str] = {}
    units = []
    for pair in pairs.values():
        for training_seed in config.seeds if pair.is_seeded else (0,):
            key = canonical(
                [pair.defense.name, pair.defense.params, pair.victim.name, pair.victim.params, training_seed]
            )
            if key not in weights:
                weights[key] = pair.weights_sha256(training_seed)
            first = Unit(
                pair=pair,
                cell=config.grid.cells()[0],
                training_seed=training_seed,
                seeds=config.grid.seeds(),
                weights_sha256=weights[key],
            )
            units += [replace(first, cell=cell) for cell in _cells(pair, config.grid.cells())]
    return units


def references(pair: Pair) -> Iterator[Pair]:
    """What a pair is held against: reference drivers in its world, or reference patches on its detector."""
    return _drivers(pair) if pair.track == "driving" else _patches(pair)


def _patches(pair: Pair) -> Iterator[Pair]:
    """The patches that know nothing, of the same size, on the same defended detector."""
    installed = registry.names("attack") if not pair.is_clean else []
    for name in REFERENCE_PATCHES:
        if name in installed and name != pair.attack.name:
            yield replace(pair, attack=choose("attack", name))


def _drivers(pair: Pair) -> Iterator[Pair]:
    """Those of its action type, and IDM, which obeys no actions."""
    own = pair.victim.component
    assert isinstance(own, DrivingVictim)
    for name in REFERENCES:
        choices = {key: p.choices for key, p in parameters(registry.load("victim", name)).items() if p.choices}
        for values in itertools.product(*choices.values()):
            victim = choose("victim", name, **dict(zip(choices, values, strict=True)))
            if name == "idm" or victim.component.action_type == own.action_type:
                none = {"attack": choose("attack", "none"), "defense": choose("defense", "none")}
                yield replace(pair, **none, victim=victim, threat=UNATTACKED["driving"])


def _cells(pair: Pair, cells: Iterable[Cell]) -> list[Cell]:
    """The cells to drive; weather cannot touch a driver that does not see."""
    victim = pair.victim.component
    if not isinstance(victim, DrivingVictim) or victim.sees:
        return list(cells)
    return list(dict.fromkeys(replace(cell, weather="clear") for cell in cells))
