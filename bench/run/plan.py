"""Splits a run into units of work: each pair, its clean control and its baselines, on every cell and block of seeds."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from cavbench.core.pair import Chosen, Pair
from cavbench.core.track import track_of
from cavbench.identity.fingerprint import canonical
from cavbench.records.schema import SEQUENTIAL
from cavbench.run.config import RunConfig
from cavbench.run.unit import Loading, Unit
from cavbench.scenarios import Axes, Cell

Weights = Mapping[str, tuple[str, str]]
"""The hashes of the networks of each loading (`key_of`)."""


def plan(config: RunConfig) -> list[Unit]:
    """The distinct units of a run: of the pairs, their clean controls and, if `reference`, their baselines.

    Loads every victim once, and every adversary, so that a missing one is reported before any work is done.

    Raises:
        UserError: if a victim or an adversary cannot be loaded.
    """
    return units_of(config, {key_of(loading): loading.weights() for loading in loadings(config)})


def loadings(config: RunConfig, *, baselines: bool = True) -> list[Loading]:
    """The networks of a run, each once: of all its pairs and training seeds; without `baselines`, of the requested pairs only.

    The first of each world also asks it about the cells of the run.
    """
    found: dict[str, Loading] = {}
    asked: set[str] = set()
    for pair in _pairs(config) if baselines else config.pairs:
        for training_seed in _training_seeds(pair, config):
            world = canonical([pair.world.name, pair.world.params])
            cells, asks = config.grid.cells(), world not in asked
            loading = Loading(pair=pair, training_seed=training_seed, cells=cells, asks_world=asks)
            found.setdefault(key_of(loading), loading)
            asked.add(world)
    return list(found.values())


def units_of(config: RunConfig, weights: Weights) -> list[Unit]:
    """The distinct units of a run, or of its shard, whose networks could be loaded.

    Every shard has every `shards`th unit, whatever could be loaded where it is driven.

    Args:
        config: the run.
        weights: by the key of the loading, the hashes of the networks.
    """
    units, place = [], 0
    own, shards = config.shard
    for pair in _pairs(config):
        for training_seed in _training_seeds(pair, config):
            parts = list(itertools.product(config.grid.blocks(), cells_of(pair, config)))
            mine = [part for number, part in enumerate(parts, place) if number % shards == own - 1]
            place += len(parts)
            loaded = weights.get(key_of(Loading(pair=pair, training_seed=training_seed)))
            if loaded is None:
                continue
            first = Unit(
                pair=pair,
                cell=config.grid.cells()[0],
                training_seed=training_seed,
                seeds=config.grid.seeds(),
                weights_sha256=loaded[0],
                adversary_sha256=loaded[1],
                sequential=config.grid.name == SEQUENTIAL,
                device=config.device,
            )
            units += [replace(first, cell=cell, seeds=seeds) for seeds, cell in mine]
    return units


def key_of(loading: Loading) -> str:
    """Equal for pairs with the same networks."""
    pair = loading.pair
    parts: list[Chosen[Any]] = [pair.defense, pair.victim, pair.world]
    parts += [pair.attack] if pair.attack.component.learns else []
    return canonical([*([part.kind, part.name, part.params] for part in parts), loading.training_seed])


def cells_of(pair: Pair, config: RunConfig) -> list[Cell]:
    """The cells that a pair drives."""
    return _cells(pair, config.grid.cells(), config.grid.axes)


def _pairs(config: RunConfig) -> Iterable[Pair]:
    clean = [pair.clean() for pair in config.pairs]
    baselines = [other for pair in config.pairs for other in track_of(pair).baselines(pair)] if config.reference else []
    return {pair.id: pair for pair in (*config.pairs, *clean, *baselines)}.values()


def _training_seeds(pair: Pair, config: RunConfig) -> tuple[int, ...]:
    return config.seeds if pair.is_seeded else (0,)


def _cells(pair: Pair, cells: Iterable[Cell], axes: Axes) -> list[Cell]:
    """The cells to drive; for a victim that ignores its input, without duplicates along perceptual axes."""
    if pair.victim.component.sees:
        return list(cells)
    return list(dict.fromkeys(axes.unperceived(cell) for cell in cells))
