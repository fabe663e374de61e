"""From records of approaches to pairs: a patch on a defended detector, beside no patch and the patches that know nothing."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from bench.plugins.contracts import REFERENCE_PATCHES
from bench.scenarios import Cell
from bench.statistics.episodes import Episodes, difference, rate, unit_interval
from bench.statistics.estimates import Interval, interval
from leaderboard.pairs import ATTACKER, DEFENDED, groups, newest

NO_PATCH = "none"


@dataclass(frozen=True)
class Measured:
    """What a set of approaches says, a whole grid or a part of it; each number is computed when it is asked for.

    Args:
        approaches: a patch seed is a run, a cell a task, an approach an episode.
    """

    approaches: Episodes

    @cached_property
    def confidence(self) -> Interval:
        """Interquartile mean of the approaches' mean confidence, in [0, 1]."""
        return unit_interval(self.approaches.column("confidence_mean"))

    @cached_property
    def detected(self) -> Interval:
        """The same of the share of frames that detect the sign, in [0, 1]."""
        return unit_interval(self.approaches.column("detection_rate"))

    @cached_property
    def first_seen_m(self) -> Interval:
        """The same of the distance at which it is first detected; 0 where it never is."""
        return interval(self.approaches.column("first_seen_m"))

    @cached_property
    def ran(self) -> Interval:
        """Share of approaches that run the sign, all pooled."""
        return rate(self.approaches, "ran")

    @property
    def overrun_m(self) -> float:
        """Mean of how far beyond the line the car stops."""
        return float(self.approaches.column("overrun_m").mean())

    @property
    def visible(self) -> float:
        """Mean visible share of the sign, in [0, 1]."""
        return float(self.approaches.column("visible_share").mean())

    @property
    def false_alarms(self) -> float:
        """Stop signs seen where there is none, mean over the frames."""
        return float(self.approaches.column("false_alarms").mean())


@dataclass(frozen=True)
class Patched:
    """One attack on one defended detector, and its controls on the same approaches, named after the same patch seeds.

    Args:
        identity: the values of `DEFENDED` and `ATTACKER`; the attack is `none` where only that was driven.
        own: its approaches.
        controls: by attack: `none`, and those of `REFERENCE_PATCHES` that were driven with a patch of the same size.
        stand_ins: the controls that have one run, which stands for all.
    """

    identity: Mapping[str, object]
    own: Episodes
    controls: Mapping[str, Episodes]
    stand_ins: frozenset[str] = frozenset()

    @property
    def attacked(self) -> bool:
        """Whether there is an attack at all."""
        return self.identity["attack"] != NO_PATCH

    @property
    def is_reference(self) -> bool:
        """Whether it is a patch that knows nothing."""
        return self.identity["attack"] in REFERENCE_PATCHES

    @cached_property
    def measured(self) -> Measured:
        return Measured(self.own)

    @cached_property
    def control(self) -> dict[str, Measured]:
        """Its controls, measured; the same run again and again would feign certainty, so it counts once."""
        once = {
            name: one.only(runs=one.runs[:1]) if name in self.stand_ins else one for name, one in self.controls.items()
        }
        return {name: Measured(approaches) for name, approaches in once.items()}

    @property
    def lost(self) -> float:
        """Share of the unattacked confidence that is gone; NaN where that is unknown or 0."""
        clean = self.control.get(NO_PATCH)
        if clean is None or not self.attacked or clean.confidence.estimate <= 0:
            return float("nan")
        return 1 - self.measured.confidence.estimate / clean.confidence.estimate

    @cached_property
    def beyond(self) -> tuple[str, Interval] | None:
        """The reference patch that takes most confidence, and attacked - patched by it, paired; None without any."""
        known = {name: one.confidence.estimate for name, one in self.control.items() if name != NO_PATCH}
        if not known or not self.attacked or self.is_reference:
            return None
        best = min(known, key=lambda name: known[name])
        return best, difference(self.own, self.controls[best], "confidence_mean")

    @property
    def locations(self) -> dict[str, list[int]]:
        """The scenario seeds of each place."""
        found: dict[str, list[int]] = {}
        for seed, place in sorted(
            set(zip(*(self.own.table[name].to_pylist() for name in ("seed", "location")), strict=True))
        ):
            found.setdefault(place, []).append(seed)
        return found

    def only(self, *, cells: Collection[Cell] | None = None, seeds: Collection[int] | None = None) -> Patched:
        """The same pair in some cells, or on some scenario seeds."""
        controls = {name: one.only(cells=cells, seeds=seeds) for name, one in self.controls.items()}
        return replace(self, own=self.own.only(cells=cells, seeds=seeds), controls=controls)


def read_patched(records: pa.Table) -> list[Patched]:
    """Every pair in the records: by world, detector and defence, the strongest attack first, what it is held against last."""
    records = newest(records, (*DEFENDED, *ATTACKER))
    found = {
        tuple(identity.values()): (identity, Episodes.arrange(rows))
        for identity, rows in groups(records, (*DEFENDED, *ATTACKER))
    }
    attacked = [(identity, own) for identity, own in found.values() if identity["attack"] != NO_PATCH]
    defended = {_values(identity, DEFENDED) for identity, _ in attacked}
    clean = groups(records, DEFENDED, pc.equal(records["attack"], NO_PATCH))
    cleans = {_values(identity, DEFENDED): Episodes.arrange(newest(rows, DEFENDED)) for identity, rows in clean}
    pairs = [_patched(identity, own, found.values(), cleans) for identity, own in attacked]
    alone = [(identity, own) for identity, own in found.values() if _values(identity, DEFENDED) not in defended]
    pairs += [Patched(identity, own, {NO_PATCH: own}) for identity, own in alone]
    return sorted(pairs, key=_rank)


def _patched(
    identity: Mapping[str, object],
    own: Episodes,
    all_found: Collection[tuple[Mapping[str, object], Episodes]],
    cleans: Mapping[tuple[object, ...], Episodes],
) -> Patched:
    same = (*DEFENDED, "threat_budget")
    candidates = {NO_PATCH: cleans.get(_values(identity, DEFENDED))}
    for other, approaches in all_found:
        if other["attack"] in REFERENCE_PATCHES and _values(other, same) == _values(identity, same):
            candidates[str(other["attack"])] = approaches
    cells, seeds = set(own.cells), set(own.seeds)
    for one in filter(None, candidates.values()):
        if cells & set(one.cells) and seeds & set(one.seeds):
            cells, seeds = cells & set(one.cells), seeds & set(one.seeds)
    own = own.only(cells=cells, seeds=seeds)
    covering = {name: one for name, one in candidates.items() if one and _covers(one, own)}
    controls = {name: _named(one, own) for name, one in covering.items()}
    return Patched(identity, own, controls, frozenset(name for name, one in covering.items() if len(one.runs) == 1))


def _covers(control: Episodes, own: Episodes) -> bool:
    runs = len(control.runs) == 1 or set(own.runs) <= set(control.runs)
    return runs and set(own.cells) <= set(control.cells) and set(own.seeds) <= set(control.seeds)


def _named(control: Episodes, own: Episodes) -> Episodes:
    """A control on the approaches of `own`; one without seeds of its own stands for every patch seed."""
    part = control.only(cells=own.cells, seeds=own.seeds)
    return part.only(runs=own.runs) if set(own.runs) <= set(part.runs) else part.standing_for(own.runs, own.cells)


def _values(identity: Mapping[str, object], names: Sequence[str]) -> tuple[object, ...]:
    return tuple(identity[name] for name in names)


def _rank(pair: Patched) -> tuple[object, ...]:
    text = {name: str(value) for name, value in pair.identity.items()}
    defended = (text["defense"] != "none", text["defense"], text["defense_params"])
    victim = tuple(text[name] for name in ("world", "world_params", "victim", "victim_params"))
    return (*victim, *defended, pair.is_reference, float(np.round(pair.measured.confidence.estimate, 9)))
