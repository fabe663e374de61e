"""The rank over worlds: the mean of a defended victim's scores, each on the scale of its world, and its worst world."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from cavbench.core.track import Track
from cavbench.leaderboard.comparisons.comparison import Comparison
from cavbench.leaderboard.ranking.boards import Board, Row
from cavbench.leaderboard.ranking.methods import Method, methods, world_name
from cavbench.leaderboard.ranking.worst import Panel, Worst
from cavbench.statistics.episodes import Episodes
from cavbench.statistics.estimates import Array, Interval, interval
from cavbench.statistics.independent import independent
from cavbench.statistics.scaled import has_scale, mean_of, over_worlds, scaled


@dataclass(frozen=True, eq=False)
class InWorld:
    """A defended victim in one of its worlds, under the attacks that it met in all of them.

    Args:
        worst: the score under the strongest of these attacks.
        parts: [R, E] of the score on the scale of the world (`cavbench.statistics.scaled`); None where there is no scale.
        blind, perfect: scores of the references on the same scenarios; None likewise.
    """

    worst: Worst
    parts: Array | None = None
    blind: float | None = None
    perfect: float | None = None

    @property
    def share(self) -> float | None:
        """The score on the scale of the world: 0 is the best blind policy, 1 is perfect information."""
        # A sum of parts may be below 0 in its last digit.
        return None if self.parts is None else min(max(float(self.parts.mean()), 0.0), 1.0)


@dataclass(frozen=True, eq=False)
class WorldRow:
    """A defended victim in several worlds.

    Args:
        method: what it is.
        places: where it was driven, by world.
        lacks: by world, why it does not count there.
        attacks: names of the attacks that it met in all of its worlds.
        parts: [R, W, E] of its mean; None for a row that lacks a world, which has no rank.
        group: rank group, from 1; 0 for a row without a rank.
    """

    method: Method
    places: Mapping[str, InWorld]
    lacks: Mapping[str, str]
    attacks: tuple[str, ...]
    parts: Array | None = None
    group: int = 0

    @cached_property
    def mean(self) -> Interval | None:
        """The mean over the worlds; None for a row without a rank."""
        return None if self.parts is None else mean_of(self.parts)

    @property
    def worst(self) -> tuple[str, float] | None:
        """The world with the lowest share, and that share; of equals the first. None for a row without a rank."""
        if self.parts is None:
            return None
        shares = {world: place.share for world, place in self.places.items() if place.share is not None}
        world = min(shares, key=lambda name: (round(shares[name], 9), name))
        return world, shares[world]

    @property
    def trained(self) -> bool:
        """Whether its runs are trainings, of which there could be others."""
        return any(place.worst.trained for place in self.places.values())

    @property
    def runs(self) -> tuple[tuple[int, ...], ...]:
        """The training seeds in each world."""
        return tuple(place.worst.runs for place in self.places.values())


@dataclass(frozen=True, eq=False)
class WorldBoard:
    """The worlds of a track under a threat model.

    Args:
        track: of the victims.
        threat: as of a `Board`.
        grids: the worlds, each with the name of the grid whose scenarios count.
        without_scale: worlds that count for no row, and why.
        rows: best first, then those without a rank.
    """

    track: Track
    threat: tuple[Any, ...]
    grids: Mapping[str, str]
    without_scale: Mapping[str, str]
    rows: tuple[WorldRow, ...] = field(default=())


def over_several(boards: Sequence[Board]) -> list[WorldBoard]:
    """A leaderboard over worlds for each track and threat model that something was driven under in two worlds or more."""
    found: dict[tuple[Any, ...], dict[str, Board]] = {}
    for board in boards:
        # Of the grids of a world the first one counts, which is the newest.
        found.setdefault((board.track.name, *board.threat), {}).setdefault(world_name(board), board)
    made = (_board(several) for several in found.values() if len(several) > 1)
    return [one for one in made if any(len(row.places) > 1 for row in one.rows)]


def _board(boards: Mapping[str, Board]) -> WorldBoard:
    first = next(iter(boards.values()))
    published = [name for name, board in boards.items() if not all(row.mine for row in board.rows)]
    # Beside published rows a world that only the user has would leave these without a rank.
    names = sorted(published if len(published) > 1 else boards, key=lambda name: (name != first.track.world, name))
    boards = {name: boards[name] for name in names}
    references = {name: _References.of(board) for name, board in boards.items()}
    without = {name: why for name in names if (why := references[name].missing(boards[name]))}
    counted = [name for name in names if name not in without]
    rows = [
        _row(method, own, references, counted)
        for method, own in methods(boards).items()
        # Without a scale nothing is said of a row but its scores, and one score is on the leaderboard of its world.
        if counted or len(own) > 1
    ]
    grids = {name: board.grid for name, board in boards.items()}
    return WorldBoard(first.track, first.threat, grids, without, tuple(ranked(rows)))


@dataclass(frozen=True, eq=False)
class _References:
    """The ends of the scale of a world.

    Args:
        blind: runs of the best blind policy, of each kind of actions; those with the most episodes first.
        perfect: those of perfect information; empty where the world has no such driver, and where it was not driven.
        offered: whether the world has such a driver.
    """

    track: Track
    blind: Mapping[str, Sequence[Episodes]]
    perfect: Sequence[Episodes]
    offered: bool

    @classmethod
    def of(cls, board: Board) -> _References:
        track, contrast = board.track, board.track.contrast
        blind: dict[str, list[Episodes]] = {}
        perfect: list[Episodes] = []
        for one in sorted(_attacks(board), key=lambda one: (-one.own.table.num_rows, one.content)):
            if contrast and contrast.baseline in one.baselines:
                blind.setdefault(str(one.identity["action_type"]), []).append(one.baselines[contrast.baseline])
            if track.perfect in one.baselines:
                perfect.append(one.baselines[track.perfect])
        facts = board.rows[0].attacks[0].facts
        return cls(track, blind, perfect, track.perfect in facts.get("drivers", ()))

    def missing(self, board: Board) -> str:
        """Why the world has no scale; empty if it has one."""
        if not (self.track.perfect and self.track.contrast):
            return "this track has no references"
        if not self.blind:
            return "no blind policy was driven there: leave out reference=false"
        if self.offered and not self.perfect:
            return (
                f"perfect information was not driven there: bench run world={board.world[0]} victim={self.track.perfect} "
                "attack=none"
            )
        most = max((row.worst for row in board.rows), key=lambda worst: (worst.scores.size, worst.most.content))
        ends = self.ends(most)
        if ends is None:
            return "its references were driven on other scenarios than its rows"
        return (
            ""
            if has_scale(*ends)
            else "perfect information is not significantly better there than the best blind policy"
        )

    def ends(self, worst: Worst) -> tuple[Array, Array] | None:
        """[C, E] the references on the scenarios of a row, the blind one as the best in each cell; None if they lack some."""
        kinds = [one for drives in self.blind.values() if (one := self._on(worst, drives)) is not None]
        top = self._on(worst, self.perfect) if self.perfect else np.ones(worst.shape)
        if not kinds or top is None:
            return None
        several = np.stack(kinds)
        return several[several.mean(2).argmax(0), np.arange(worst.shape[0])], top

    def _on(self, worst: Worst, drives: Sequence[Episodes]) -> Array | None:
        cells, seeds = worst.cells, worst.panel.seeds
        for one in drives:
            if set(cells) <= set(one.cells) and set(seeds) <= set(one.seeds):
                return np.asarray(one.column(self.track.metric)[one.places(one.runs[:1], cells, seeds)][0])
        return None


def _attacks(board: Board) -> Iterator[Comparison]:
    for row in board.rows:
        yield from (*row.attacks, *row.left_out)


def _row(
    method: Method, rows: Mapping[str, Row], references: Mapping[str, _References], counted: Sequence[str]
) -> WorldRow:
    """A row of the leaderboard, without its rank."""
    names = [{str(one.identity["attack"]) for one in row.attacks} for row in rows.values()]
    common = set.intersection(*names)
    lacks = {name: "not driven" for name in counted if name not in rows}
    places = {}
    # In the order of the tables, whatever the order of the records was.
    for name in (one for one in references if one in rows):
        row = rows[name]
        place = _place(row, common, references[name] if name in counted else None)
        places[name] = place
        if name not in counted:
            continue
        if not common:
            lacks[name] = "no attack was driven in all of its worlds"
        elif all(one.queries == 0 for one in _some(row, common)):
            # Its score there is not one under attack. NaN, which is no 0, where records do not count queries.
            lacks[name] = f"no attack that it met in all of its worlds asked it anything ({', '.join(sorted(common))})"
        elif place.parts is None:
            lacks[name] = (
                "there is no scale on its scenarios: references lack some, or perfect information is no better"
            )
    found = WorldRow(method, places, lacks, tuple(sorted(common)))
    if lacks or not counted:
        return found
    shared = set.intersection(*(set(places[name].worst.runs) for name in counted))
    if not shared:
        return replace(found, lacks=dict.fromkeys(counted, "no training seed was driven in all worlds"))
    own = [places[name] for name in counted]
    parts = [_of_runs(place, shared) for place in own]
    return replace(found, parts=over_worlds(parts))


def _of_runs(place: InWorld, runs: set[int]) -> Array:
    """[R, E] the parts of these trainings."""
    assert place.parts is not None, "a world that counts has a scale"
    return place.parts[[number for number, run in enumerate(place.worst.runs) if run in runs]]


def _place(row: Row, common: set[str], references: _References | None) -> InWorld:
    """A row in a world under the attacks in `common`; without a share where the world has no scale."""
    some = _some(row, common)
    # All attacks of the row: its score is that of its leaderboard.
    whole = len(some) == len(row.attacks) + len(row.left_out) or not some
    worst = row.worst if whole else Panel.of(some).strongest() or row.worst
    ends = references.ends(worst) if references else None
    if ends is None:
        return InWorld(worst)
    low, high = ends
    if not (high - low).mean() > 0:
        return InWorld(worst)
    return InWorld(worst, scaled(worst.scores, low, high), float(low.mean()), float(high.mean()))


def _some(row: Row, names: set[str]) -> list[Comparison]:
    """The attacks on a row with these names."""
    return [one for one in (*row.attacks, *row.left_out) if str(one.identity["attack"]) in names]


def ranked(rows: Sequence[WorldRow]) -> Iterator[WorldRow]:
    """Best mean first, in groups whose rows are not significantly below the first; then those that lack the fewest worlds."""

    def order(row: WorldRow) -> tuple[object, ...]:
        mean = -round(row.mean.estimate, 9) if row.mean else float(len(row.lacks))
        return (row.mean is None, mean, row.method)

    group, leader = 0, None
    for row in sorted(rows, key=order):
        if row.parts is None:
            yield row
            continue
        if leader is None or _below(row, leader):
            group, leader = group + 1, row
        yield replace(row, group=group)


def _below(row: WorldRow, leader: WorldRow) -> bool:
    """Whether a mean is significantly lower, paired scenario by scenario; by the rules of `boards`."""
    assert row.parts is not None, "it has a rank"
    assert leader.parts is not None, "it has a rank"
    count = min(row.parts.shape[2], leader.parts.shape[2])
    first, second = leader.parts[..., :count], row.parts[..., :count]
    rules = not (row.trained or leader.trained)
    if rules or (row.runs == leader.runs and first.shape == second.shape and len(first) > 1):
        return interval(first - second).low > 0
    return independent(first, second, trained=(leader.trained, row.trained)).low > 0
