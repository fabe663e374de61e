"""The honest ranking: of each defended victim the worst attack counts, cell by cell; flagged rows come last."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import get_args

import pyarrow as pa

from bench.plugins.contracts import TRACKS, Access, Track
from bench.statistics.episodes import Episodes
from bench.statistics.estimates import Interval
from leaderboard.entries import Entry, read_entries
from leaderboard.flags import Flag, Subject, flags
from leaderboard.overview import NAMES
from leaderboard.worst import Worst, worst

THREAT = ("threat_norm", "threat_budget", "threat_access", "threat_queries")


@dataclass(frozen=True, eq=False)
class Row:
    """A defended victim on a leaderboard.

    Args:
        entries: the attacks that count: first the one that is the strongest in most cells.
        worst: what they leave.
        clean: without an attack in the same cells; None where that was not driven.
        flags: each with its measurement, fired or not.
        group: rank group, from 1; rows of a group cannot be told from its first. Flagged rows follow the others.
    """

    entries: tuple[Entry, ...]
    worst: Worst
    clean: Interval | None
    flags: tuple[Flag, ...]
    group: int = 0

    @property
    def identity(self) -> Mapping[str, object]:
        """Of what is defended, and of its strongest attack."""
        return self.entries[0].identity

    @property
    def flagged(self) -> bool:
        """Whether any flag has fired."""
        return any(flag.fired for flag in self.flags)


@dataclass(frozen=True, eq=False)
class Board:
    """The leaderboard of a threat model in a world.

    Args:
        track: of its victims.
        world: name and parameters.
        threat: the values of `THREAT`.
        rows: best first; flagged ones last.
        references: drivers that learn nothing, by what they are called.
    """

    track: Track
    world: tuple[str, str]
    threat: tuple[str, float, str, int]
    rows: tuple[Row, ...]
    references: Mapping[str, Episodes] = field(default_factory=dict)


def boards(entries: Sequence[Entry]) -> list[Board]:
    """A leaderboard for every threat model in which something was attacked."""
    attacked = [entry for entry in entries if entry.attacked]
    keys = sorted({_key(entry) for entry in attacked}, key=_board_rank)
    return [_board(key, attacked) for key in keys]


Key = tuple[Track, str, str, str, float, str, int]


def _key(entry: Entry) -> Key:
    identity = entry.identity
    return (entry.track, *(identity[name] for name in ("world", "world_params", *THREAT)))  # type: ignore[return-value]


def _board_rank(key: Key) -> tuple[object, ...]:
    """Driving first, then by world; the standard norm first, the largest budget and the most access first."""
    track, world, params, norm, budget, access, queries = key
    return TRACKS.index(track), world, params, norm != "relative", norm, -budget, -_access(access), -queries


def _access(name: str) -> int:
    known: tuple[str, ...] = get_args(Access)
    return known.index(name) if name in known else len(known)


def _board(key: Key, attacked: Sequence[Entry]) -> Board:
    track, world, world_params, *threat = key
    allowed = [entry for entry in attacked if _within(entry, key)]
    rows = []
    for defended in dict.fromkeys(entry.defended for entry in attacked if _key(entry) == key):
        own = [entry for entry in allowed if entry.defended == defended]
        found = worst(own)
        own.sort(key=lambda entry: (-found.attacks.count(entry), entry.score.estimate))
        others = [
            entry for entry in attacked if entry.defended == defended and entry.identity["threat_norm"] == threat[0]
        ]
        rows.append(Row(tuple(own), found, found.clean, tuple(flags(Subject(track, own, others, found)))))
    return Board(track, (world, world_params), tuple(threat), tuple(ranked(rows)), _references(allowed))  # type: ignore[arg-type]


def _within(entry: Entry, key: Key) -> bool:
    """Whether the threat model allows what an attack did: it had no more knowledge, budget and queries."""
    track, world, world_params, norm, budget, access, queries = key
    identity = entry.identity
    return (
        (entry.track, identity["world"], identity["world_params"], identity["threat_norm"])
        == (track, world, world_params, norm)
        and float(str(identity["threat_budget"])) <= budget
        and _access(str(identity["threat_access"])) <= _access(access)
        and int(str(identity["threat_queries"])) <= queries
    )


def ranked(rows: Iterable[Row]) -> Iterator[Row]:
    """Best first, flagged ones last, in groups: a group's rows have intervals that overlap that of its first."""
    ordered = sorted(rows, key=lambda row: (row.flagged, -row.worst.score.estimate))
    group, leader = 0, None
    for row in ordered:
        if leader is None or row.flagged != leader.flagged or row.worst.score.high < leader.worst.score.low:
            group, leader = group + 1, row
        yield replace(row, group=group)


def _references(entries: Sequence[Entry]) -> dict[str, Episodes]:
    """Drivers that do not see, by what they are called: of each type of action where they differ, on the scenarios of who was
    driven most. They have no training seeds, so one run says it all.
    """
    found: dict[str, dict[str, Episodes]] = {}
    for entry in sorted(entries, key=lambda entry: -entry.own.table.num_rows):
        actions = entry.own.table["action_type"][0].as_py()
        for name, drive in entry.references.items():
            found.setdefault(NAMES.get(name, name), {}).setdefault(actions, drive.only(runs=drive.runs[:1]))
    return {
        f"{name}, {actions}" if len({drive.table["unit"][0] for drive in drives.values()}) > 1 else name: drive
        for name, drives in found.items()
        for actions, drive in sorted(drives.items(), reverse=True)
    }


def read_boards(records: Mapping[Track, pa.Table]) -> tuple[list[Board], list[Entry]]:
    """The leaderboards that records make, and all that was driven."""
    entries = read_entries(records)
    return boards(entries), entries
