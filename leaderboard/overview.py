"""The overview of a run: a section a defended victim, a row an attack, and the reference drivers below."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.statistics.episodes import MAX_RETURN, Summary, summarise
from leaderboard.layout import STRIP, Column, Section, axis, fitted
from leaderboard.pairs import BEST_BLIND, DEFENDED, Pair
from leaderboard.text import (
    ATTACKED,
    BLIND,
    CLEAN,
    bounds,
    change,
    component,
    estimate,
    number,
    share,
    strip,
    varying,
    verdict,
)

NAMES = {BEST_BLIND: "best blind policy", "idm": "IDM and MOBIL"}


@dataclass(frozen=True)
class Line:
    """A name and what was measured; `pair` where it is an attack."""

    name: str
    colour: str
    summary: Summary
    pair: Pair | None = None


def overview(pairs: Sequence[Pair], console: Console) -> Table:
    """Every pair in one table, the strongest attack on a defended victim first."""
    return fitted(_columns(attacked=any(pair.attacked for pair in pairs)), list(_sections(pairs)), console)


def _columns(*, attacked: bool) -> list[Column[Line]]:
    columns: list[Column[Line]] = [
        Column("", lambda line: f"  {line.name}", "left", folds=True),
        Column("safe progress\n[95 %]", lambda line: estimate(line.summary.safe_progress, style=line.colour), "left"),
    ]
    if attacked:
        columns += [
            Column("kept", lambda line: share(line.pair.retained) if line.pair else ""),
            Column("against\nbest blind", lambda line: _lead(line, interval=False), "left"),
            Column("\n[95 %]", lambda line: _lead(line, interval=True), "left", spare=7),
        ]
    columns += [
        Column(f"return\nof {MAX_RETURN:.0f}", lambda line: number(line.summary.episode_return.estimate)),
        Column("crashed", lambda line: share(line.summary.crash_rate.estimate)),
        Column("off\nroad", lambda line: share(line.summary.offroad_rate.estimate), spare=4),
        Column("min\nTTC s", lambda line: number(line.summary.min_ttc_s, 1), spare=6),
    ]
    if attacked:
        columns += [
            Column("success\n/ step", lambda line: share(line.summary.attack_success) if line.pair else "", spare=2),
            Column("queries\n/ step", lambda line: number(line.summary.queries_mean) if line.pair else ""),
            Column("ms\n/ step", lambda line: number(line.summary.attack_ms, 1) if line.pair else "", spare=3),
        ]
    columns.append(
        Column(axis(), lambda line: strip({line.colour: line.summary.safe_progress}, STRIP), "left", spare=9)
    )
    return columns


def _lead(line: Line, *, interval: bool) -> Text:
    lead = line.pair.lead if line.pair else None
    if lead is None:
        return Text("")
    return bounds(lead) if interval else Text.assemble(verdict(lead), " ", change(lead))


def size(pairs: Sequence[Pair]) -> str:
    """What the pairs were measured on, where it is the same for all."""
    sizes = {(str(pair.identity.get("grid") or "no attack"), pair.driven.shape) for pair in pairs}
    if len(sizes) > 1:
        return "several grids"
    grid, (runs, cells, episodes) = sizes.pop()
    return f"{grid}: {_count(cells, 'cell')} of {_count(episodes, 'scenario')}, {_count(runs, 'training seed')}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' if number != 1 else ''}"


def _sections(pairs: Sequence[Pair]) -> Iterator[Section[Line]]:
    shown = {column: varying(pairs, column) for column in ("attack", "defense", "victim", "world")}
    for _, group in groupby(pairs, key=lambda pair: [pair.identity[name] for name in DEFENDED]):
        members = list(group)
        title = Text(component(members[0], "victim", shown["victim"]), style="bold")
        if members[0].identity["defense"] != "none":
            title.append(f" + {component(members[0], 'defense', shown['defense'])}")
        if shown["world"]:
            title.append(f" in {component(members[0], 'world', shown['world'])}", style="dim")
        control = next((pair.clean_summary for pair in members if pair.clean_summary), None)
        lines = [Line("no attack", CLEAN, control)] if control else []
        for pair in members:
            if pair.attacked_summary:
                name = component(pair, "attack", shown["attack"]) + _threat_words(pair, pairs)
                lines.append(Line(name, ATTACKED, pair.attacked_summary, pair))
        yield Section(lines, title)
    yield from _reference_sections(pairs)


def _threat_words(pair: Pair, pairs: Sequence[Pair]) -> str:
    """What tells the threat models of a sweep apart."""
    identities = [other.identity for other in pairs if other.attacked]
    names = ("threat_norm", "threat_budget", "threat_access", "threat_queries", "grid")
    return "".join(f" {pair.identity[name]}" for name in names if len({str(each[name]) for each in identities}) > 1)


def _reference_sections(pairs: Sequence[Pair]) -> Iterator[Section[Line]]:
    """The reference drivers, once a world and action type: they have no training seeds, so one run says it all."""

    def kind(pair: Pair) -> tuple[str, ...]:
        first = pair.driven.table.slice(0, 1).to_pylist()[0]
        return tuple(str(first[name]) for name in ("action_type", "world", "world_params"))

    kinds = {kind(pair): pair for pair in reversed(pairs) if pair.references}
    for (action_type, *_), pair in kinds.items():
        title = Text("reference drivers", style="bold")
        if len(kinds) > 1:
            title.append(f" of {action_type} actions")
        lines = [
            Line(NAMES.get(name, name), BLIND, summarise(drive.only(runs=drive.runs[:1])))
            for name, drive in pair.references.items()
        ]
        yield Section(lines, title)
