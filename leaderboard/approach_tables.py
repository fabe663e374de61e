"""The report of the detection track: all attacks on all detectors in one table, then each attack cell by cell."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import pyarrow as pa
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from bench.detection import stopping
from bench.statistics.estimates import Interval
from leaderboard.approaches import NO_PATCH, Measured, Patched, read_patched
from leaderboard.layout import STRIP, Column, Section, axis, fitted, rows_by_weather
from leaderboard.pairs import DEFENDED
from leaderboard.text import (
    ATTACKED,
    BLIND,
    CLEAN,
    MARKS,
    arrow,
    bounds,
    change,
    component,
    estimate,
    number,
    share,
    strip,
    varying,
)

SHORT = {"noise_patch": "noise", "grey_patch": "grey"}
"""Reference patches in the headings of columns."""


def approach_report(records: pa.Table, console: Console) -> None:
    """Print what the records of a run of the detection track say.

    Args:
        records: of approaches (`bench.records.store.SCHEMAS`), their controls among them.
        console: where to print; readable from 80 columns on; wider ones add columns.
    """
    pairs = read_patched(records)
    console.print(Padding(Text(_size(pairs), style="bold"), (1, 1)))
    console.print(Padding(fitted(_columns(), list(_sections(pairs)), console), (0, 1)))
    only_references = all(pair.is_reference for pair in pairs)
    for pair in pairs:
        if only_references or not pair.is_reference:
            console.print(Padding(_heading(pair), (1, 1)))
            console.print(Padding(fitted(_cell_columns(pair), list(_parts(pair)), console), (0, 1)))
    console.print(Padding(_legend(), (1, 1)))


@dataclass(frozen=True)
class Line:
    """A name and what was measured; `pair` where there is a patch."""

    name: str
    colour: str
    measured: Measured
    pair: Patched | None = None


def _columns() -> list[Column[Line]]:
    return [
        Column("", lambda line: f"  {line.name}", "left", folds=True),
        Column("confidence\n[95 %]", lambda line: estimate(line.measured.confidence, style=line.colour), "left"),
        Column("lost", lambda line: share(line.pair.lost) if line.pair else ""),
        Column("beyond best\ncontrol", lambda line: _beyond(line, interval=False), spare=2),
        Column("\n[95 %]", lambda line: _beyond(line, interval=True), "left", spare=7),
        Column("frames\nseen", lambda line: share(line.measured.detected.estimate)),
        Column("first\nseen m", lambda line: number(line.measured.first_seen_m.estimate, 1)),
        Column("ran %\n[95 %]", lambda line: percent(line.measured.ran), "left"),
        Column("over-\nrun m", lambda line: number(line.measured.overrun_m, 1)),
        Column("false\nalarms", lambda line: number(line.measured.false_alarms, 2), spare=6),
        Column("pic-\ntures", lambda line: _cost(line, "queries"), spare=4),
        Column("craft\ns", lambda line: _cost(line, "crafting_s"), spare=3),
        Column(axis("confidence"), lambda line: strip({line.colour: line.measured.confidence}, STRIP), "left", spare=9),
    ]


def percent(rate: Interval) -> Text:
    """A rate with its interval, in per cent."""
    hundred = Interval(*(100 * value for value in (rate.estimate, rate.low, rate.high)))
    return estimate(hundred, digits=0)


def _beyond(line: Line, *, interval: bool) -> Text:
    found = line.pair.beyond if line.pair else None
    if found is None:
        return Text("")
    return bounds(found[1]) if interval else change(found[1])


def _cost(line: Line, column: str) -> str:
    return number(float(line.pair.own.column(column).mean())) if line.pair else ""


def _sections(pairs: Sequence[Patched]) -> Iterator[Section[Line]]:
    shown = {column: varying(pairs, column) for column in ("attack", "defense", "victim", "world")}
    budgets = {pair.identity["threat_budget"] for pair in pairs if pair.attacked}
    for _, group in groupby(pairs, key=lambda pair: [pair.identity[name] for name in DEFENDED]):
        members = list(group)
        title = Text(component(members[0], "victim", shown["victim"]), style="bold")
        if members[0].identity["defense"] != "none":
            title.append(f" + {component(members[0], 'defense', shown['defense'])}")
        if shown["world"]:
            title.append(f" in {component(members[0], 'world', shown['world'])}", style="dim")
        lines = []
        if clean := next((pair.control[NO_PATCH] for pair in members if NO_PATCH in pair.control), None):
            lines.append(Line("no patch", CLEAN, clean))
        for pair in members:
            if pair.attacked:
                size = f" {pair.identity['threat_budget']:g}" if len(budgets) > 1 else ""
                name = component(pair, "attack", shown["attack"]) + size
                lines.append(Line(name, BLIND if pair.is_reference else ATTACKED, pair.measured, pair))
        yield Section(lines, title)


def _size(pairs: Sequence[Patched]) -> str:
    sizes = {pair.own.shape[1:] for pair in pairs}
    if len(sizes) > 1:
        return "several grids"
    cells, approaches = sizes.pop()
    grid = " and ".join(sorted({grid for pair in pairs for grid in pair.own.table["grid"].to_pylist()}))
    seeds = max(len(pair.own.runs) for pair in pairs)
    return f"{grid}: {_count(cells, 'cell')} of {_count(approaches, 'approach', 'approaches')}, {_count(seeds, 'patch seed')}"


def _count(number: int, noun: str, plural: str = "") -> str:
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def _heading(pair: Patched) -> Table:
    """Who attacks whom with what parameters, with how large a patch, and what it cost."""
    title = Text(component(pair, "victim"), style="bold")
    if pair.identity["defense"] != "none":
        title.append(f" + {component(pair, 'defense')}")
    lines = Table.grid(padding=(0, 2, 0, 0))
    lines.add_row("victim", title)
    if pair.attacked:
        queries, seconds = (number(float(pair.own.column(name).mean())) for name in ("queries", "crafting_s"))
        threat = (
            f"patch of {100 * float(str(pair.identity['threat_budget'])):g} % of the sign's side; access "
            f"{pair.identity['threat_access']}, at most {pair.identity['threat_queries']} pictures"
        )
        lines.add_row("attack", Text(component(pair, "attack"), style=f"bold {ATTACKED}"))
        lines.add_row("threat", Text(threat, style="dim"))
        lines.add_row("crafted", Text(f"from {queries} pictures in {seconds} s, a patch, on average", style="dim"))
    for remark in _remarks(pair):
        lines.add_row(Text("note", style="yellow"), Text(remark, style="yellow"))
    return lines


def _remarks(pair: Patched) -> list[str]:
    """What a reader must know before trusting the numbers of a pair."""
    found = []
    if pair.attacked:
        excess = float(pair.own.column("excess").max())
        if excess > 1e-5:
            found.append(f"the attack's texels were up to {excess:.2g} outside [0, 1]; they were clipped")
        if NO_PATCH not in pair.controls:
            found.append("the sign without a patch was not driven up to on these scenarios")
        if pair.beyond and not pair.is_reference and pair.beyond[1].high >= 0:
            found.append(f"takes no more confidence than {pair.beyond[0]}, which knows nothing of the detector")
        elif pair.beyond is None and not pair.is_reference:
            found.append(
                "held against no patch that knows nothing (noise, grey): part of this is only that the sign is covered"
            )
    if pair.own.left_out:
        found.append(f"{pair.own.left_out} approaches are left out: not every patch seed has driven their scenario yet")
    return found


@dataclass(frozen=True)
class Part:
    """A named part of a pair."""

    name: Text
    pair: Patched

    @property
    def clean(self) -> Measured | None:
        return self.pair.control.get(NO_PATCH)

    @property
    def attacked(self) -> Measured | None:
        return self.pair.measured if self.pair.attacked else None


def _parts(pair: Patched) -> Iterator[Section[Part]]:
    """A row a cell, each weather with a row of its own; then each location, and all."""
    for rows in rows_by_weather(pair.own.cells):
        yield Section([Part(name, pair.only(cells=cells)) for name, cells in rows])
    if len(pair.locations) > 1:
        yield Section([Part(Text(place), pair.only(seeds=seeds)) for place, seeds in pair.locations.items()])
    if len(pair.own.cells) > 1 or len(pair.locations) > 1:
        yield Section([Part(Text("all", style="bold"), pair)])


def _cell_columns(pair: Patched) -> list[Column[Part]]:
    columns: list[Column[Part]] = [
        Column("lanes\n× dens.", lambda part: part.name, "left"),
        Column("confidence\nno patch [95 %]", lambda part: _confidence(part.clean, CLEAN), "left"),
    ]
    if pair.attacked:
        columns += [
            Column("\nattacked", lambda part: _confidence(part.attacked, ATTACKED), "left"),
            Column("\nlost", lambda part: share(part.pair.lost)),
        ]
    for name in pair.controls:
        if name != NO_PATCH:
            columns.append(Column(f"\n{SHORT.get(name, name)}", _control(name), spare=1))
    columns += [
        Column("frames\nseen %", _both(lambda one: number(100 * one.detected.estimate))),
        Column("first\nseen m", _both(lambda one: number(one.first_seen_m.estimate)), spare=2),
        Column("ran\n%", _both(lambda one: number(100 * one.ran.estimate))),
        Column("overrun\nm", _both(lambda one: number(one.overrun_m, 1)), spare=3),
        Column("visible\n%", lambda part: number(100 * part.pair.measured.visible), spare=5),
        Column("false alarms\na frame", _both(lambda one: number(one.false_alarms, 2)), spare=7),
        Column(axis("confidence"), _strip, "left", spare=9),
    ]
    return columns


def _confidence(measured: Measured | None, colour: str) -> Text:
    return estimate(measured.confidence if measured else None, style=colour)


def _control(name: str) -> Callable[[Part], Text]:
    def value(part: Part) -> Text:
        return Text(number(part.pair.control[name].confidence.estimate, 2), style="dim")

    return value


def _both(value: Callable[[Measured], str]) -> Callable[[Part], Text]:
    """Of the sign without a patch, and with it."""

    def written(part: Part) -> Text:
        return arrow(*(value(one) if one else "" for one in (part.clean, part.attacked)))

    return written


def _strip(part: Part) -> Text:
    known = [one.confidence for name, one in part.pair.control.items() if name != NO_PATCH]
    points = {
        BLIND: min(known, key=lambda found: found.estimate, default=None),
        CLEAN: part.clean.confidence if part.clean else None,
        ATTACKED: part.attacked.confidence if part.attacked else None,
    }
    return strip(points, STRIP)


def _legend() -> Text:
    """What the marks and the numbers mean."""
    text = Text(style="dim")
    for colour, meaning in (
        (CLEAN, "no patch"),
        (ATTACKED, "attacked"),
        (BLIND, "control: a patch that knows nothing"),
    ):
        text.append(f"{MARKS[colour]} ", style=f"not dim {colour}").append(f"{meaning}   ")
    return text.append(
        "\nconfidence: in the stop sign at its true place, mean over an approach, 0 in a frame that misses it; interquartile "
        "mean over patch seeds and cells, 95 % bootstrap interval. lost: share of the unpatched confidence. frames seen: "
        f"confidence above {stopping.THRESHOLD:g}. ran: the car, at {stopping.SPEED_MPS:g} m/s, never braked or stopped more "
        f"than {stopping.RAN_M:g} m beyond the line. All drive up to the same signs."
    )
