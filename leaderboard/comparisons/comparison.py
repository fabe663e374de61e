"""An attack on a defended victim, with what it is compared with on the same scenarios: one model for every track."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import pyarrow.compute as pc

from cavbench.core.track import Measure, Track
from cavbench.leaderboard.comparisons.pairing import beside
from cavbench.scenarios import Axes, Cell
from cavbench.statistics.doubts import mean
from cavbench.statistics.episodes import Episodes, difference, measured
from cavbench.statistics.estimates import Array, Interval, share_interval

DEFENDED = ("defense", "defense_params", "victim", "victim_params", "world", "world_params")
"""The columns that name what is attacked; a clean control shares them with the attacked episodes."""
THREAT = ("threat_norm", "threat_budget", "threat_access", "threat_queries", "threat_share")
ATTACKER = ("attack", "attack_params", *THREAT)
IDENTITY = (*DEFENDED, *ATTACKER, "grid", "action_type", "sees")
"""The columns that all episodes of a comparison share."""
NO_ATTACK = "none"
ENOUGH_SEEDS = 3
"""Training or patch seeds below which nothing is claimed."""
Knowledge = Literal["nothing", "answers", "gradients", "unknown"]


@dataclass(frozen=True, eq=False)
class Comparison:
    """One attack on one defended victim, and what it is compared with.

    Args:
        identity: the values of `IDENTITY`; the attack is `none` where nothing was attacked.
        track: of the victim.
        own: the episodes, under attack if there is an attack.
        clean: the same scenarios without an attack; None where they were not driven. A single run stands for every run of `own`
            whose training seed changes nothing in the victim.
        audit: the same attack on the same defended victim, on scenarios that an audit drew; None where there was none.
        baselines: the same scenarios by name of a baseline (`Track.baseline_of`), in the cells that it has.
        mine: whether the records are a user's own, where they stand beside published ones.
    """

    identity: Mapping[str, Any]
    track: Track
    own: Episodes
    clean: Episodes | None
    baselines: Mapping[str, Episodes]
    audit: Episodes | None = None
    mine: bool = False

    @property
    def is_attacked(self) -> bool:
        """Whether there is an attack at all."""
        return bool(self.identity["attack"] != NO_ATTACK)

    @cached_property
    def is_baseline(self) -> bool:
        """Whether others are compared with it."""
        return bool(self.track.baseline_of(self.identity, self.identity))

    @property
    def attacked(self) -> Episodes | None:
        """The episodes under attack."""
        return self.own if self.is_attacked else None

    @property
    def defended(self) -> tuple[object, ...]:
        """What is attacked: the values of `DEFENDED`."""
        return tuple(self.identity[name] for name in DEFENDED)

    @property
    def ranked_as(self) -> tuple[object, ...]:
        """The row of a leaderboard that it is in: what is attacked, in a user's own records or in others."""
        return (*self.defended, self.mine)

    @cached_property
    def settings(self) -> dict[str, object]:
        """All it was run with, by name: defended victim, attack, threat model, and the attack's parameters as `attack.NAME`."""
        params = parameters(self.identity["attack_params"])
        plain = {name: self.identity[name] for name in (*DEFENDED, *ATTACKER) if name != "attack_params"}
        return plain | {f"attack.{name}": value for name, value in params.items()}

    @property
    def cells(self) -> tuple[Cell, ...]:
        """The cells that were driven."""
        return self.own.cells

    @property
    def axes(self) -> Axes:
        """What the cells differ in."""
        return self.own.axes

    @cached_property
    def facts(self) -> dict[str, Any]:
        """Of the world: axes, decision rate, episode length, actions."""
        return dict(json.loads(self.own.table["world_facts"][0].as_py()))

    def only(self, *, cells: Collection[Cell] | None = None, seeds: Collection[int] | None = None) -> Comparison:
        """The same in some of its cells, or on some scenario seeds."""

        def part(episodes: Episodes) -> Episodes | None:
            apart = (cells is not None and not set(cells) & set(episodes.cells)) or (
                seeds is not None and not set(seeds) & set(episodes.seeds)
            )
            return None if apart else episodes.only(cells=cells, seeds=seeds)

        baselines = {name: kept for name, one in self.baselines.items() if (kept := part(one))}
        own = self.own.only(cells=cells, seeds=seeds)
        return replace(self, own=own, clean=self.clean and part(self.clean), baselines=baselines)

    @cached_property
    def places(self) -> dict[str, list[int]]:
        """The scenario seeds of each place (`Track.place`); empty where the track has none."""
        return _places(self.own, self.track)

    @cached_property
    def scores(self) -> Array:
        """[R, C, E] of the metric."""
        return self.own.column(self.track.metric)

    @cached_property
    def score(self) -> Interval:
        """The metric over all runs and cells."""
        return share_interval(of_places(self.scores, self.own.seeds, self.places))

    @cached_property
    def clean_score(self) -> Interval | None:
        """The same without an attack."""
        return self.score_of(self.clean) if self.clean else None

    @cached_property
    def baseline_scores(self) -> dict[str, Interval]:
        """The same of each baseline."""
        return {name: self.score_of(one) for name, one in self.baselines.items()}

    def score_of(self, episodes: Episodes) -> Interval:
        """The metric of other episodes, over all runs and cells."""
        return share_interval(
            of_places(episodes.column(self.track.metric), episodes.seeds, _places(episodes, self.track))
        )

    @property
    def retained(self) -> float:
        """Attacked over clean score; NaN where there is no attack, or the clean score is unknown or 0."""
        if not self.is_attacked or self.clean_score is None or self.clean_score.estimate <= 0:
            return float("nan")
        return self.score.estimate / self.clean_score.estimate

    @cached_property
    def effect(self) -> Interval | None:
        """Attacked - clean score, paired scenario by scenario."""
        return self._minus(self.clean)

    @cached_property
    def rival(self) -> str:
        """The baseline that scores under attack are compared with (`Track.contrast`); empty where there is none."""
        contrast = self.track.contrast
        if contrast is None or self.is_baseline or not self.baselines:
            return ""
        if contrast.baseline:
            return contrast.baseline if contrast.baseline in self.baselines else ""
        return min(self.baselines, key=lambda name: self.baseline_scores[name].estimate)

    @cached_property
    def lead(self) -> Interval | None:
        """Attacked - rival's score, paired scenario by scenario."""
        return self._minus(self.baselines.get(self.rival))

    def _minus(self, control: Episodes | None) -> Interval | None:
        if control is None or not self.is_attacked:
            return None
        return difference(*beside(self.own, control), self.track.metric)

    def measured(self, measure: Measure) -> Interval:
        """A column of the track's reports."""
        return measured(self.own, measure)

    @cached_property
    def queries(self) -> float:
        """Mean number of questions to the victim, in the unit of the track; NaN where they are not counted."""
        return self.mean(self.track.queries)

    @cached_property
    def knowledge(self) -> Knowledge:
        """What the attack asked of the victim, as measured; `unknown` where records do not say."""
        gradients = self.mean(self.track.gradients)
        if gradients > 0:
            return "gradients"
        if self.queries == 0:
            return "nothing"
        return "unknown" if np.isnan(gradients) else "answers"

    @cached_property
    def trained(self) -> bool:
        """Whether its runs are trainings, or patches, of which there could be others; a driver without weights learns nothing."""
        weights = set(pc.unique(self.own.table["weights_sha256"]).to_pylist())
        return self.track.artefact is not None or bool(weights - {""})

    @property
    def content(self) -> tuple[str, ...]:
        """What it is, as text: an order that no order of files, records or arguments changes."""
        return tuple(str(self.identity[name]) for name in IDENTITY)

    @property
    def stands_for_all(self) -> bool:
        """Whether its one run counts for every run of others: a baseline attack that depends on no seed."""
        return self.is_baseline and len(self.own.runs) == 1

    def mean(self, name: str) -> float:
        """Mean of a column over all episodes; NaN where nothing was measured."""
        return mean(self.own.table, name)


def parameters(canonical: object) -> dict[str, object]:
    """The parameters of a component from the canonical JSON of a record; those of the links of a chain as `LINK.NAME`."""
    found = json.loads(str(canonical) or "{}")
    return _flat(found) if isinstance(found, dict) else {}


def _flat(params: dict[str, object]) -> dict[str, object]:
    found: dict[str, object] = {}
    for name, value in params.items():
        if isinstance(value, dict):
            found |= {f"{name}.{inner}": each for inner, each in _flat(value).items()}
        else:
            found[name] = value
    return found


def of_places(values: Array, seeds: Sequence[int], places: Mapping[str, Sequence[int]]) -> Array:
    """[R, C, P] means of each place, whose scenarios look the same, of values [R, C, E]; the values where there are no places."""
    place_of = {seed: place for place, own in places.items() for seed in own}
    if not place_of:
        return values
    names = [place_of[seed] for seed in seeds]
    return np.stack([values[..., [own == name for own in names]].mean(-1) for name in dict.fromkeys(names)], -1)


def _places(episodes: Episodes, track: Track) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    if track.place:
        columns = (episodes.table[name].to_pylist() for name in ("seed", track.place))
        for seed, place in sorted(set(zip(*columns, strict=True))):
            found.setdefault(place, []).append(seed)
    return found
