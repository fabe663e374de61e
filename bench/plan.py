"""A run as units of work: every pair, its clean control and the reference drivers, on every cell of the grid."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace

from bench import registry
from bench.config import RunConfig
from bench.fingerprint import canonical
from bench.pair import UNATTACKED, Pair, choose
from bench.parameters import parameters
from bench.scenario import Cell
from bench.unit import Unit

REFERENCES = ("blind", "random", "idm")
"""The drivers that every victim is held against."""


def plan(config: RunConfig) -> list[Unit]:
    """Every unit of a run, each once: the pairs, their clean controls and, if asked for, the reference drivers.

    Loads every policy once, so that one that is missing is refused before any work.

    Raises:
        UserError: if a policy cannot be loaded.
    """
    clean = [pair.clean() for pair in config.pairs]
    reference = [other for pair in clean for other in references(pair)] if config.reference else []
    pairs = {pair.id: pair for pair in (*config.pairs, *clean, *reference)}
    weights: dict[str, str] = {}
    units = []
    for pair in pairs.values():
        victim = pair.victim.component
        for training_seed in config.seeds if victim.learns else (0,):
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
    """The reference drivers in a pair's world: those of its action type, and IDM, which obeys no actions."""
    for name in REFERENCES:
        choices = {key: p.choices for key, p in parameters(registry.load("victim", name)).items() if p.choices}
        for values in itertools.product(*choices.values()):
            victim = choose("victim", name, **dict(zip(choices, values, strict=True)))
            if name == "idm" or victim.component.action_type == pair.victim.component.action_type:
                none = {"attack": choose("attack", "none"), "defense": choose("defense", "none")}
                yield replace(pair, **none, victim=victim, threat=UNATTACKED)


def _cells(pair: Pair, cells: Iterable[Cell]) -> list[Cell]:
    """The cells to drive; weather cannot touch a driver that does not see."""
    if pair.victim.component.sees:
        return list(cells)
    return list(dict.fromkeys(replace(cell, weather="clear") for cell in cells))
