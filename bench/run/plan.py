"""Splits a run into units of work: each pair, its clean control and its baselines, on every cell of the grid."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from bench.plugins.fingerprint import canonical
from bench.plugins.pair import Pair
from bench.plugins.track import track_of
from bench.run.config import RunConfig
from bench.run.unit import Unit
from bench.scenarios import Axes, Cell


def plan(config: RunConfig) -> list[Unit]:
    """The distinct units of a run: of the pairs, their clean controls and, if `reference`, their baselines.

    Loads every victim once, and every adversary, so that a missing one is reported before any work is done.

    Raises:
        UserError: if a victim or an adversary cannot be loaded.
    """
    clean = [pair.clean() for pair in config.pairs]
    baselines = [other for pair in config.pairs for other in track_of(pair).baselines(pair)] if config.reference else []
    pairs = {pair.id: pair for pair in (*config.pairs, *clean, *baselines)}
    weights: dict[str, str] = {}
    units = []
    for pair in pairs.values():
        for training_seed in config.seeds if pair.is_seeded else (0,):
            loaded = (pair.defense, pair.victim, pair.world)
            key = canonical([*([part.name, part.params] for part in loaded), training_seed])
            if key not in weights:
                weights[key] = pair.weights_sha256(training_seed)
            first = Unit(
                pair=pair,
                cell=config.grid.cells()[0],
                training_seed=training_seed,
                seeds=config.grid.seeds(),
                weights_sha256=weights[key],
                adversary_sha256=pair.adversary_sha256(training_seed),
            )
            units += [replace(first, cell=cell) for cell in _cells(pair, config.grid.cells(), config.grid.axes)]
    return units


def _cells(pair: Pair, cells: Iterable[Cell], axes: Axes) -> list[Cell]:
    """The cells to drive; for a victim that ignores its input, without duplicates along perceptual axes."""
    if pair.victim.component.sees:
        return list(cells)
    return list(dict.fromkeys(axes.unperceived(cell) for cell in cells))
