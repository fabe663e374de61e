"""Finds what belongs together on two sides: the same attack on the same defended victim, or what takes its place.

Rows of equal components belong together. Where only one is left on either side, these two do: so two defences or two versions
of an attack can be compared. Another world, or another threat model, is another question: it is never compared.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cavbench.core.track import Track
from cavbench.errors import UserError
from cavbench.leaderboard.comparisons.baselines import identity_of
from cavbench.leaderboard.comparisons.comparison import ATTACKER, DEFENDED, NO_ATTACK, THREAT, Comparison, parameters
from cavbench.leaderboard.comparisons.naming import labels
from cavbench.leaderboard.comparisons.pairing import without_seed
from cavbench.leaderboard.comparisons.reading import distinct, groups, newest
from cavbench.records.schema import AUDIT
from cavbench.scenarios import Cell
from cavbench.statistics.episodes import Episodes
from cavbench.statistics.estimates import Array

SHOWN = {f"{kind}_params": kind for kind in ("defense", "victim", "world", "attack")}
OFFERED = ("axes", "drivers")
"""Facts of a world that say what it offers, and nothing about a scenario."""
ACCESS = THREAT.index("threat_access")
Key = tuple[object, ...]
Fit = Callable[[Key], Key]


@dataclass(frozen=True, eq=False)
class Match:
    """The same row on both sides, on what both have driven.

    Args:
        first, second: the rows.
        runs, cells, seeds: training seeds [R], cells [C] and scenario seeds [E] that both have.
    """

    first: Comparison
    second: Comparison
    runs: tuple[int, ...]
    cells: tuple[Cell, ...]
    seeds: tuple[int, ...]

    def scores(self) -> tuple[Array, Array]:
        """[R, C, E] of either side.

        Raises:
            UserError: if a score is not finite.
        """
        found = [one.scores[one.own.places(self.runs, self.cells, self.seeds)] for one in (self.first, self.second)]
        if not all(np.isfinite(scores).all() for scores in found):
            raise UserError(f"a score under {self.first.identity['attack']} is not a number: the records are damaged")
        return found[0], found[1]


class Matching:
    """Finds what belongs together.

    Args:
        names: of the sides.
        first, second: their rows.

    `matches` is what can be compared, `left` what only one side has, `why` why something cannot be compared.
    """

    def __init__(self, names: tuple[str, str], first: Sequence[Comparison], second: Sequence[Comparison]) -> None:
        self.names = names
        self.called = Names([*first, *second])
        self.matches: list[Match] = []
        self.left: list[str] = []
        self.why: list[str] = []
        sides = [by(rows, lambda one: one.defended) for rows in (first, second)]
        both = _paired(sides[0], sides[1], (_same_parts, _same_world))
        for one, other in both:
            self._attacks(sides[0].pop(one), sides[1].pop(other))
        for name, side in zip(names, sides, strict=True):
            self.left += [f"only {name} has {self.called.defended(rows[0])}" for rows in side.values()]
        self.why += [
            f"{name} has no records of public scenarios"
            for name, rows in zip(names, (first, second), strict=True)
            if not rows
        ]
        if not (both or self.why):
            self._say_why(first[0], second[0], DEFENDED)

    def _attacks(self, first: Sequence[Comparison], second: Sequence[Comparison]) -> None:
        sides = [{_attacker(one): one for one in rows} for rows in (first, second)]
        for key, other in _paired(sides[0], sides[1], (_same_but_access, _same_attack, _same_threat), (NO_ATTACK,)):
            self._add(sides[0].pop(key), sides[1].pop(other))
        for name, side in zip(self.names, sides, strict=True):
            self.left += [f"only {name} has {self.called.row(one)}" for one in side.values()]
        attacked = [next((one for one in side.values() if one.is_attacked), None) for side in sides]
        if attacked[0] and attacked[1] and attacked[0].identity["attack"] == attacked[1].identity["attack"]:
            self._say_why(attacked[0], attacked[1], ATTACKER)

    def _add(self, first: Comparison, second: Comparison) -> None:
        about = self.called.row(first)
        facts = [{key: value for key, value in side.facts.items() if key not in OFFERED} for side in (first, second)]
        if differing := [key for key in {**facts[0], **facts[1]} if facts[0].get(key) != facts[1].get(key)]:
            self.why.append(f"{about}: the worlds differ in {', '.join(differing)}")
            return
        one, other = first.own, second.own
        runs = [run for run in one.runs if run in other.runs]
        if without_seed(one, other) or without_seed(other, one):
            runs = list(one.runs if len(one.runs) > len(other.runs) else other.runs)
        cells = [cell for cell in one.cells if cell in other.cells]
        seeds = [seed for seed in one.seeds if seed in other.seeds]
        if runs and cells and seeds:
            self.matches.append(Match(first, second, tuple(runs), tuple(cells), tuple(seeds)))
            return
        what = f"no {first.track.run}" if not runs else "no cell" if not cells else f"no {first.track.episode[0]}"
        self.why.append(f"{about}: {what} in common")

    def _say_why(self, first: Comparison, second: Comparison, columns: Sequence[str]) -> None:
        said = []
        for column in columns:
            values = [one.identity[column] for one in (first, second)]
            if values[0] != values[1]:
                said.append(f"{SHOWN.get(column, column)} {_told(*values)}")
        if said:
            self.why.append(f"{self.names[0]} and {self.names[1]} differ in {', '.join(said)}")


def _told(one: object, other: object) -> str:
    """Two values that differ; of parameters those that do."""
    if not str(one).startswith("{"):
        return f"({one} and {other})"
    sets = parameters(one), parameters(other)
    names = [name for name in {**sets[0], **sets[1]} if sets[0].get(name) != sets[1].get(name)]
    return ", ".join(f"{name} ({sets[0].get(name)} and {sets[1].get(name)})" for name in names[:3])


def _same_parts(key: Key) -> Key:
    """The same victim, defence and world, with other parameters of victim or defence."""
    named = dict(zip(DEFENDED, key, strict=True))
    return tuple(named[name] for name in ("defense", "victim", "world", "world_params"))


def _same_world(key: Key) -> Key:
    """The same world with its parameters."""
    return key[DEFENDED.index("world") :]


def _same_but_access(key: Key) -> Key:
    """The same attack under a threat model that may allow more than it needs."""
    return (*key[: 2 + ACCESS], *key[3 + ACCESS :])


def _same_attack(key: Key) -> Key:
    """The same attack under such a threat model, with other parameters."""
    return (key[0], *_same_but_access(key)[2:])


def _same_threat(key: Key) -> Key:
    """Such a threat model."""
    return _same_but_access(key)[2:] if key[0] != NO_ATTACK else key


def _paired(
    first: Iterable[Key], second: Iterable[Key], fits: Sequence[Fit], trivial: Key = ()
) -> list[tuple[Key, Key]]:
    """The keys that belong together: equal ones, then the only two that are alike.

    Args:
        first, second: the keys of either side.
        fits: what must be equal of the only two that are alike, the closest first. By the last fit only what is left alone on
            either side belongs together, and only if nothing else does.
        trivial: a key that both may have without being of interest: no attack.
    """
    sides = [list(first), list(second)]
    found = [(key, key) for key in sides[0] if key in sides[1]]
    for fit in fits:
        if fit is fits[-1] and not all(key == trivial for key, _ in found):
            break
        taken = [{pair[side] for pair in found} for side in (0, 1)]
        there = [by([key for key in keys if key not in own], fit) for keys, own in zip(sides, taken, strict=True)]
        found += [
            (own[0], there[1][what][0])
            for what, own in there[0].items()
            if len(own) == len(there[1].get(what, ())) == 1
        ]
    return found


def by(values: Iterable[Any], key: Callable[[Any], Any]) -> dict[Any, list[Any]]:
    """Values in lists of those that have the same key."""
    found: dict[Any, list[Any]] = {}
    for value in values:
        found.setdefault(key(value), []).append(value)
    return found


def _attacker(one: Comparison) -> Key:
    """What attacks: name, parameters, threat model; of no attack the name alone."""
    if not one.is_attacked:
        return (NO_ATTACK,)
    return (one.identity["attack"], one.identity["attack_params"], *(one.identity[name] for name in THREAT))


def rows_of(records: pa.Table, of: Track) -> list[Comparison]:
    """A row for each attack on each defended victim, and for each without one; baselines are left out if there are others."""
    public = records.filter(pc.not_equal(records["grid"], AUDIT))
    records = distinct(newest(public, (*DEFENDED, *ATTACKER)), of)
    found = []
    for columns, keep in (
        ((*DEFENDED, *ATTACKER), pc.not_equal(records["attack"], NO_ATTACK)),
        (DEFENDED, pc.equal(records["attack"], NO_ATTACK)),
    ):
        for _, rows in groups(records, columns, keep):
            own = Episodes.arrange(newest(rows, columns))
            found.append(Comparison(identity_of(own), of, own, None, {}))
    attacked = {one.defended for one in found if one.is_attacked}
    kept = [one for one in found if one.defended in attacked or not one.is_baseline]
    return sorted(kept or found, key=lambda one: (one.is_attacked, one.content))


class Names:
    """What rows are called, with the parameters that tell them apart.

    Args:
        rows: all rows of both sides.
    """

    def __init__(self, rows: Sequence[Comparison]) -> None:
        self.called = {kind: labels(rows, kind) for kind in ("attack", "defense", "victim")}

    def _of(self, one: Comparison, kind: str) -> str:
        return self.called[kind][one.identity[kind], one.identity[f"{kind}_params"]]

    def attack(self, one: Comparison) -> str:
        """The attack."""
        return self._of(one, "attack") if one.is_attacked else "no attack"

    def defended(self, one: Comparison) -> str:
        """The victim, with its defence where it has one."""
        kinds = ("victim", "defense") if one.identity["defense"] != "none" else ("victim",)
        return " + ".join(self._of(one, kind) for kind in kinds)

    def row(self, one: Comparison) -> str:
        """Both."""
        return f"{self.attack(one)} on {self.defended(one)}"
