"""What a leaderboard is made of: an attack on a defended victim, of either track, in one shape."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from bench.plugins.contracts import REFERENCE_PATCHES, Track
from bench.scenarios import Cell
from bench.statistics.episodes import Episodes, unit_interval
from bench.statistics.estimates import Array, Interval, interval
from leaderboard.approaches import NO_PATCH, read_patched
from leaderboard.pairs import ATTACKER, BEST_BLIND, DEFENDED, parameters, read_pairs

METRICS: dict[Track, str] = {"driving": "safe_progress", "detection": "confidence_mean"}
"""What each track is ranked by; both in [0, 1], and more is better for the victim."""
MEASUREMENTS: dict[Track, tuple[str, ...]] = {
    "driving": ("steps", "return", "safe_progress", "crashed", "offroad", "changed", "queries", "attack_ms"),
    "detection": (
        "location", "confidence_mean", "detection_rate", "first_seen_m", "ran", "overrun_m", "visible_share", "false_alarms",
        "queries", "gradients", "crafting_s", "patch_sha256",
    ),
}  # fmt: skip
"""The columns of records that a leaderboard reads, beside what was driven and what produced it."""
Knowledge = Literal["nothing", "answers", "gradients", "unknown"]


@dataclass(frozen=True, eq=False)
class Entry:
    """One attack on one defended victim.

    Args:
        track: of the victim.
        identity: the values of `DEFENDED` and `ATTACKER`; the attack is `none` where nothing was attacked.
        own: what was driven under attack.
        clean: the same scenarios without an attack; None where they were not driven.
        references: those who know nothing on the same scenarios, by name: drivers that do not see.
    """

    track: Track
    identity: Mapping[str, object]
    own: Episodes
    clean: Episodes | None
    references: Mapping[str, Episodes]

    @property
    def attacked(self) -> bool:
        """Whether there is an attack at all."""
        return self.identity["attack"] != NO_PATCH

    @property
    def defended(self) -> tuple[object, ...]:
        """What is attacked: the values of `DEFENDED`."""
        return tuple(self.identity[name] for name in DEFENDED)

    @cached_property
    def settings(self) -> dict[str, object]:
        """All it was run with, name by name: `identity`, and each of the attack's parameters as `attack.NAME`."""
        params = parameters(self.identity["attack_params"])
        identity = {name: value for name, value in self.identity.items() if name != "attack_params"}
        return identity | {f"attack.{name}": value for name, value in params.items()}

    @property
    def metric(self) -> str:
        """The column it is ranked by."""
        return METRICS[self.track]

    @cached_property
    def scores(self) -> Array:
        """[R, C, E] of the ranking metric."""
        return self.own.column(self.metric)

    @cached_property
    def score(self) -> Interval:
        """Of the ranking metric, over all runs and cells."""
        return unit_interval(self.scores)

    @cached_property
    def control(self) -> Episodes | None:
        """The same without an attack; one that stands for several patch seeds is there once."""
        if self.clean is None or self.track == "driving":
            return self.clean
        return self.clean.only(runs=self.clean.runs[:1])

    @cached_property
    def clean_score(self) -> Interval | None:
        """Of the ranking metric without an attack."""
        return unit_interval(self.control.column(self.metric)) if self.control else None

    @property
    def blind(self) -> Episodes | None:
        """The best blind policy on the same scenarios."""
        return self.references.get(BEST_BLIND)

    @cached_property
    def queries(self) -> float:
        """Mean evaluations of the victim: a step, or a patch."""
        return self.mean("queries")

    @cached_property
    def knowledge(self) -> Knowledge:
        """What the attack asked of the victim, as measured; `unknown` where records are too old to say."""
        gradients = self.mean("gradients" if self.track == "detection" else "gradient_queries")
        if gradients > 0:
            return "gradients"
        if self.queries == 0:
            return "nothing"
        return "unknown" if np.isnan(gradients) else "answers"

    @property
    def stands_for_all(self) -> bool:
        """Whether its one run counts for every patch seed: a patch that depends on no seed."""
        return self.identity["attack"] in REFERENCE_PATCHES and len(self.own.runs) == 1

    def mean(self, name: str) -> float:
        """Mean of a column over all episodes; NaN where nothing was measured."""
        return mean(self.own.table, name)


def mean(records: pa.Table, name: str) -> float:
    """Mean of a column, without nulls; NaN where there is nothing else."""
    found = pc.mean(records[name].cast(pa.float64())).as_py()
    return float("nan") if found is None else float(found)


def read_entries(records: Mapping[Track, pa.Table]) -> list[Entry]:
    """Every attack on every defended victim, and those that nobody attacked.

    Args:
        records: by track.
    """
    found = []
    if "driving" in records:
        found += [
            Entry("driving", _identity(pair.identity), pair.driven, pair.clean, pair.references)
            for pair in read_pairs(records["driving"])
            if pair.attacked or pair.driven.table["sees"][0].as_py()
        ]
    if "detection" in records:
        for patched in read_patched(records["detection"]):
            clean = patched.controls.get(NO_PATCH)
            found.append(Entry("detection", _identity(patched.identity), patched.own, clean, {}))
    return found


def _identity(of: Mapping[str, object]) -> dict[str, object]:
    return {name: of[name] for name in (*DEFENDED, *ATTACKER) if name in of}


def gap(first: Entry, second: Entry) -> Interval | None:
    """`first` minus `second`, paired on the runs, cells and scenarios that both have; None where they have none."""
    aligned = align([first, second])
    return interval(aligned.scores[0] - aligned.scores[1]) if aligned else None


@dataclass(frozen=True, eq=False)
class Aligned:
    """Several entries on the scenarios that all of them have.

    Args:
        scores: [R, C, E] each, of the ranking metric.
        runs: training or patch seeds [R].
        cells: [C].
        seeds: scenario seeds [E].
    """

    scores: list[Array]
    runs: tuple[int, ...]
    cells: tuple[Cell, ...]
    seeds: tuple[int, ...]


def align(entries: list[Entry]) -> Aligned | None:
    """Entries on the runs, cells and scenario seeds that all of them have; None where there are none."""
    own = [entry.own for entry in entries]
    seeded = [entry.own.runs for entry in entries if not entry.stands_for_all] or [own[0].runs]
    runs = sorted(set.intersection(*map(set, seeded)))
    cells = [cell for cell in own[0].cells if all(cell in one.cells for one in own)]
    seeds = sorted(set.intersection(*(set(one.seeds) for one in own)))
    if not (runs and cells and seeds):
        return None
    scores = []
    for entry in entries:
        kept_runs = entry.own.runs * len(runs) if entry.stands_for_all else runs
        axes = (
            [entry.own.runs.index(run) for run in kept_runs],
            [entry.own.cells.index(cell) for cell in cells],
            [entry.own.seeds.index(seed) for seed in seeds],
        )
        scores.append(entry.scores[np.ix_(*axes)])
    return Aligned(scores, tuple(runs), tuple(cells), tuple(seeds))
