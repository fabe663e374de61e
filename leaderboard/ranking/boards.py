"""The ranking: of each defended victim the worst attack of each cell counts; flagged rows come last."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, get_args

import pyarrow as pa

from cavbench.core import registry
from cavbench.core.contracts import Access
from cavbench.core.track import Track
from cavbench.errors import UserError
from cavbench.leaderboard.comparisons.beside import beside
from cavbench.leaderboard.comparisons.comparison import THREAT, Comparison
from cavbench.leaderboard.comparisons.reading import read_tracks
from cavbench.leaderboard.ranking.faults import FaultRow, Faults, is_fault, of, under_faults
from cavbench.leaderboard.ranking.flags import Flag, Subject, flags
from cavbench.leaderboard.ranking.remarks import fault_remarks, row_remarks
from cavbench.leaderboard.ranking.worst import Panel, Worst, margin
from cavbench.statistics import doubts
from cavbench.statistics.doubts import Remark
from cavbench.statistics.episodes import Episodes
from cavbench.statistics.estimates import Interval


@dataclass(frozen=True, eq=False)
class Row:
    """A defended victim on a leaderboard.

    Args:
        attacks: those that count: first the one that is the strongest in most cells.
        worst: the score under the strongest of each cell.
        marginal: by how much each attack lowers the score further than all the others do.
        left_out: attacks that were driven on other scenarios, or on a part of them.
        flags: each with its measurement, fired or not.
        group: rank group, from 1; rows of a group cannot be told from its first. Flagged rows follow the others. 0 for a row
            without a rank: its victim sees nothing without an attack (`hopeless`), or it has one patch (`one_patch`).
        faults: its scores under faults, which rank nothing; None where they were not driven.
    """

    attacks: tuple[Comparison, ...]
    worst: Worst
    marginal: Mapping[Comparison, Interval]
    left_out: tuple[Comparison, ...]
    flags: tuple[Flag, ...]
    group: int = 0
    faults: FaultRow | None = None
    site: Worst | None = None
    """The score under attackers who know the site (`threat.knows=site`) with the same budget; None where there are none."""

    @property
    def identity(self) -> Mapping[str, object]:
        """Of what is defended, and of its strongest attack."""
        return self.attacks[0].identity

    @property
    def mine(self) -> bool:
        """Whether it is of the records of a user, beside published ones."""
        return self.attacks[0].mine

    @property
    def flagged(self) -> bool:
        """Whether any flag has fired."""
        return any(flag.fired for flag in self.flags)

    @property
    def one_patch(self) -> bool:
        """Whether its attacks were crafted once, on a track whose attacks are crafted: another patch may take more or less."""
        return self.worst.most.track.artefact is not None and len(self.worst.scores) == 1

    @cached_property
    def hopeless(self) -> bool:
        """Whether its victim does nothing without an attack, so that its score says nothing."""
        most = self.worst.most
        found = doubts.of_victim(most.own.table, most.clean.table if most.clean else None, most.track)
        return any(remark.name == "hopeless" for remark in found)

    @property
    def remarks(self) -> list[Remark]:
        """What a reader must know of its score besides the flags."""
        return [*row_remarks(self.worst), *fault_remarks(self.faults, self.worst)]


@dataclass(frozen=True, eq=False)
class Board:
    """The leaderboard of a threat model on a grid of a world.

    Args:
        track: of its victims.
        world: name and parameters.
        grid: name of the grid; `custom` for any that has none.
        threat: the values of `THREAT`.
        rows: best first; flagged ones last.
        baselines: victims that ignore their input, by title.
    """

    track: Track
    world: tuple[str, str]
    grid: str
    threat: tuple[Any, ...]
    rows: tuple[Row, ...]
    baselines: Mapping[str, Episodes] = field(default_factory=dict)


SITE = "knows=site"
"""In `threat_norm` of attackers who prepare on the scenarios that are scored."""
Key = tuple[Any, ...]
"""Track, world and its parameters, grid, and the values of `THREAT`."""


def boards(comparisons: Sequence[Comparison]) -> list[Board]:
    """A leaderboard for every threat model and grid on which something was attacked.

    The track with the most episodes comes first; then by world, the newest grid (custom ones last), the norm with the most
    episodes, the largest budget, the most access.
    """
    attacked = sorted((one for one in comparisons if one.is_attacked), key=lambda one: one.content)
    faults = under_faults(attacked)
    # Faults rank nothing beside attacks. Alone they are all that is known.
    attacked = [one for one in attacked if not is_fault(one)] or attacked
    episodes: Counter[tuple[str, ...]] = Counter()
    for one in attacked:
        for key in ((one.track.name,), (one.track.name, str(one.identity["threat_norm"]))):
            episodes[key] += one.own.table.num_rows
    tracks = {_key(one): one.track for one in attacked}

    def rank(key: Key) -> tuple[object, ...]:
        track, world, params, grid, norm, budget, access, queries, share = key
        named = [one.name for one in registry.grids(world)]
        return (
            -episodes[track,],
            track,
            world,
            params,
            -named.index(grid) if grid in named else 1,
            -episodes[track, norm],
            norm,
            -budget,
            -_access(access),
            -queries,
            -share,
        )

    return [_board(key, tracks[key], attacked, faults) for key in sorted(tracks, key=rank)]


def _key(one: Comparison) -> Key:
    return (one.track.name, *(one.identity[name] for name in ("world", "world_params", "grid", *THREAT)))


def _access(name: str) -> int:
    known: tuple[str, ...] = get_args(Access)
    return known.index(name) if name in known else len(known)


def _board(key: Key, track: Track, attacked: Sequence[Comparison], faults: Faults) -> Board:
    _, world, world_params, grid, *threat = key
    allowed = [one for one in attacked if _within(one, key)]
    rows = []
    for defended in dict.fromkeys(one.ranked_as for one in attacked if _key(one) == key):
        panel = Panel.of([one for one in allowed if one.ranked_as == defended])
        found = panel.strongest()
        assert found is not None, "the attack whose seeds the panel has has a cell"
        # Those that were dropped from a race, too.
        own = (*found.order, *(one for one in panel.whole.attacks if one not in found.order))
        same = [one for one in attacked if one.ranked_as == defended and one.identity["grid"] == grid]
        others = [one for one in same if one.identity["threat_norm"] == threat[0]]
        raised = tuple(flags(Subject(track, own, others, found)))
        site = _at_site(key, defended, attacked)
        marginal = panel.marginal(found)
        rows.append(Row(own, found, marginal, panel.left_out, raised, faults=of(own[0], faults), site=site))
    return Board(track, (world, world_params), grid, tuple(threat), tuple(ranked(rows)), _baselines(allowed))


def _at_site(key: Key, defended: object, attacked: Sequence[Comparison]) -> Worst | None:
    """The score of what is defended where the attacker also knows the site; None where that was not driven."""
    track, world, world_params, grid, norm, *rest = key
    knowing = (track, world, world_params, grid, f"{norm}+{SITE}", *rest)
    found = [one for one in attacked if one.ranked_as == defended and _within(one, knowing)]
    return Panel.of(found).strongest() if found else None


def _within(one: Comparison, key: Key) -> bool:
    """Whether the threat model allows what an attack did: it had no more knowledge, budget, queries and frames."""
    track, world, world_params, grid, norm, budget, access, queries, share = key
    identity = one.identity
    same = tuple(identity[name] for name in ("world", "world_params", "grid", "threat_norm"))
    return (
        (one.track.name, *same) == (track, world, world_params, grid, norm)
        and float(str(identity["threat_budget"])) <= budget
        and _access(str(identity["threat_access"])) <= _access(access)
        and int(str(identity["threat_queries"])) <= queries
        and float(str(identity["threat_share"])) <= share
    )


def ranked(rows: Iterable[Row]) -> Iterator[Row]:
    """Best first, flagged ones last, in groups whose rows are not significantly below the first; then those without a rank."""
    ordered = sorted(rows, key=lambda row: (row.hopeless, row.one_patch, row.flagged, *_order(row)))
    group, leader = 0, None
    for row in ordered:
        if row.hopeless or row.one_patch:
            yield row
            continue
        if leader is None or row.flagged != leader.flagged or _below(row.worst, leader.worst):
            group, leader = group + 1, row
        yield replace(row, group=group)


def _order(row: Row) -> tuple[float, object]:
    """By the score, and rows that do nothing by their names."""
    name = row.attacks[0].ranked_as
    return (0.0 if row.hopeless else -round(row.worst.score.estimate, 9)), name


def _below(row: Worst, leader: Worst) -> bool:
    """Whether a score is significantly lower, paired on what both have; by their intervals where that is nothing.

    The interval of one training says nothing about others, so it tells no rows apart.
    """
    if lead := margin(leader, row):
        return lead.low > 0
    alone = any(one.trained and len(one.runs) == 1 for one in (row, leader))
    return not alone and row.score.high < leader.score.low


def _baselines(attacks: Sequence[Comparison]) -> dict[str, Episodes]:
    """Victims that ignore their input, by title; of each type of action where they differ, on the most-driven scenarios.

    They have no training seeds, so one run counts.
    """
    found: dict[str, dict[str, Episodes]] = {}
    for one in sorted(attacks, key=lambda one: (-one.own.table.num_rows, one.content)):
        contrast = one.track.contrast
        if contrast is None or contrast.side != "victim":
            continue
        for name, drive in one.baselines.items():
            kind = one.track.baseline_kinds.get(name)
            kinds = found.setdefault(kind.title if kind else name, {})
            kinds.setdefault(str(one.identity["action_type"]), drive.only(runs=drive.runs[:1]))
    named: dict[str, Episodes] = {}
    for name, drives in found.items():
        if len({drive.table["unit"][0] for drive in drives.values()}) > 1:
            named |= {f"{name}, {actions}": drive for actions, drive in sorted(drives.items(), reverse=True)}
        else:
            # The same driver for every type of action: on the most-driven scenarios.
            named[name] = min(drives.items(), key=lambda item: (-item[1].table.num_rows, item[0]))[1]
    return named


def read_boards(
    records: Mapping[str, pa.Table], published: Mapping[str, pa.Table] | None = None
) -> tuple[list[Board], list[Comparison]]:
    """The leaderboards that records make, and all that was driven and can be compared.

    Args:
        records: by track.
        published: other records, by track; None for none. Leaderboards have the rows of both, the first marked as a user's own,
            and only those leaderboards are made that have such a row.

    Raises:
        UserError: if `published` is given and no attack is in `records`.
    """
    comparisons = read_tracks(records)
    if published is None:
        return boards(comparisons), comparisons
    both = beside(comparisons, read_tracks(published))
    if not any(one.is_attacked for one in comparisons):
        raise UserError("nothing was attacked: there is no row to stand beside the published ones")
    return boards(both), both
