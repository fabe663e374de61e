"""Races the attacks of suites: all drive a pilot, the strongest two of each defended victim drive the rest.

All that is decided follows from records: a run that was killed decides the same when it is resumed. What a run with `race=false`
drives beside that are the same units as ever, so it completes what a race left out.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow.compute as pc

from cavbench.core.pair import Pair
from cavbench.core.track import track_of
from cavbench.run import stops
from cavbench.run.results import Results
from cavbench.run.stops import Stop
from cavbench.run.unit import Unit
from cavbench.statistics.episodes import Episodes
from cavbench.statistics.estimates import Array, share_interval
from cavbench.statistics.racing import KEPT, PILOT_RUNS, PILOT_SCENARIOS, kept

Drive = Callable[[Sequence[Unit]], Collection[str]]
"""Drives units, and returns the fingerprints of those that are finished."""


def race(plan: Any, units: Sequence[Unit], drive: Drive, rest: Drive, results: Results) -> list[str]:
    """Drive the pilot, then the rest with the attacks that go on. Return the fingerprints of all units that were wanted.

    Every dropped pair has a file that says by which (`cavbench.run.stops`).

    Args:
        plan: the `cavbench.run.plan.Plan`, with attacks that race.
        units: all of its units.
        drive: carries out units.
        rest: the same for the units that are the last of the run.
        results: the results folder.
    """
    pilot, later = _parts(plan, units)
    finished = drive(pilot)
    if not later:
        # The pilot is all there is: nothing is dropped.
        return [unit.fingerprint for unit in pilot]
    on: set[str] = set()
    for group in groups(plan):
        found = _scores(group, pilot, finished, results)
        # Of an attack that failed in the pilot, nothing is known.
        raced = [pair for pair in group if pair.id in found]
        chosen = [raced[place] for place in kept(np.stack([found[pair.id] for pair in raced]))] if raced else []
        on |= {pair.id for pair in chosen}
        for pair in raced:
            if pair not in chosen:
                stops.write(results.folder, _dropped(pair, found[pair.id], chosen, plan.grid.episodes))
    others = [unit for unit in later if unit.pair.id in on]
    rest(others)
    return [unit.fingerprint for unit in (*pilot, *others)]


def groups(plan: Any) -> list[list[Pair]]:
    """The pairs that race each other: members of suites on the same defended victim, in the same threat model.

    So few that all would go on do not race, nor do those on a grid whose first block is no pilot.
    """
    found: dict[object, list[Pair]] = {}
    if plan.grid.block != PILOT_SCENARIOS:
        return []
    for pair in plan.pairs:
        if pair.id in plan.racing:
            parts = [(part.name, part.params) for part in (pair.defense, pair.victim, pair.world)]
            key = repr((parts, sorted(pair.threat.columns.items())))
            found.setdefault(key, []).append(pair)
    return [pairs for pairs in found.values() if len(pairs) > KEPT]


def _scores(
    group: Sequence[Pair], pilot: Sequence[Unit], finished: Collection[str], results: Results
) -> Mapping[str, Array]:
    """[R, C, E] of each pair of which all units of the pilot are finished."""
    own: dict[str, list[Unit]] = {pair.id: [] for pair in group}
    for unit in pilot:
        if unit.pair.id in own:
            own[unit.pair.id].append(unit)
    whole = {name: units for name, units in own.items() if units and all(one.fingerprint in finished for one in units)}
    if not whole:
        return {}
    track = track_of(group[0])
    records = results.records([unit.fingerprint for units in whole.values() for unit in units], track)
    return {
        name: Episodes.arrange(records.filter(pc.equal(records["pair"], name))).column(track.metric) for name in whole
    }


def _dropped(pair: Pair, scores: Array, by: Sequence[Pair], most: int) -> Stop:
    found = share_interval(scores)
    return Stop(
        pair=pair.id,
        why="raced out",
        by=tuple(one.id for one in by),
        until=None,
        scenarios=scores.shape[-1],
        most=most,
        estimate=found.estimate,
        low=found.low,
        high=found.high,
    )


def dearest(plan: Any, units: Sequence[Unit], seconds: Callable[[Pair], float]) -> list[Unit]:
    """The units of a race if those attacks go on that cost the most; all of them where nothing races.

    Args:
        plan: the `cavbench.run.plan.Plan`.
        units: all of its units.
        seconds: what an episode of a pair costs.
    """
    pilot, rest = _parts(plan, units)
    costly = [sorted(group, key=seconds)[-KEPT:] for group in groups(plan)]
    on = {pair.id for group in costly for pair in group}
    return [*pilot, *(unit for unit in rest if unit.pair.id in on)]


def _parts(plan: Any, units: Sequence[Unit]) -> tuple[list[Unit], list[Unit]]:
    """What is driven in any case, and what only the attacks drive that go on."""
    racing = {pair.id for group in groups(plan) for pair in group}
    end = plan.grid.first_seed + PILOT_SCENARIOS
    first = plan.seeds[:PILOT_RUNS]
    sides: tuple[list[Unit], list[Unit]] = ([], [])
    for unit in units:
        later = unit.seeds.stop > end or (unit.pair.is_seeded and unit.training_seed not in first)
        sides[unit.pair.id in racing and later].append(unit)
    return sides
