"""One pair cell by cell: lanes x density, grouped by weather, clean beside attacked beside the reference drivers."""

from __future__ import annotations

import math
from collections.abc import Callable

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.statistics.episodes import MAX_RETURN, Summary
from bench.statistics.estimates import Interval
from leaderboard.layout import STRIP, Column, Section, axis, fitted, rows_by_weather
from leaderboard.pairs import BEST_BLIND, IDM, Pair
from leaderboard.text import ATTACKED, BLIND, CLEAN, MISSING, arrow, estimate, number, share, strip, verdict


def cell_by_cell(pair: Pair, console: Console) -> Table:
    """A row a cell; each weather and the whole grid have rows of their own."""
    sections = [
        Section([_Part(name, pair.only(cells)) for name, cells in rows]) for rows in rows_by_weather(pair.cells)
    ]
    if len(sections) > 1:
        sections.append(Section([_Part(Text("all", style="bold"), pair)]))
    return fitted(_columns(pair), sections, console)


class _Part:
    """A named part of a pair."""

    def __init__(self, name: Text, pair: Pair) -> None:
        self.name = name
        self.pair, self.clean, self.attacked = pair, pair.clean_summary, pair.attacked_summary

    def reference(self, name: str) -> Interval | None:
        return self.pair.reference_scores.get(name)


def _columns(pair: Pair) -> list[Column[_Part]]:
    columns: list[Column[_Part]] = [
        Column("lanes\n× dens.", lambda part: part.name, "left"),
        Column("safe progress\nclean [95 %]", lambda part: _progress(part.clean, CLEAN), "left"),
    ]
    if pair.attacked:
        columns += [
            Column("\nattacked", lambda part: _progress(part.attacked, ATTACKED), "left"),
            Column("\nkept", lambda part: share(part.pair.retained)),
            Column(" \n ", lambda part: verdict(part.pair.lead)),
        ]
    titles = {BEST_BLIND: "best\nblind", "random": "ran-\ndom", IDM: "\nIDM"}
    for name in pair.references:
        columns.append(Column(titles.get(name, name), _reference(name), spare=0 if name == BEST_BLIND else 5))
    columns += [
        Column(f"return\nof {MAX_RETURN:.0f}", lambda part: arrow(_returns(part.clean), _returns(part.attacked))),
        Column("crashed\n%", lambda part: arrow(_crashes(part.clean), _crashes(part.attacked))),
    ]
    if pair.attacked:
        columns += [
            Column(
                "success\n/ step", lambda part: share(part.attacked.attack_success) if part.attacked else "", spare=2
            ),
            Column("queries\n/ step", lambda part: number(part.attacked.queries_mean) if part.attacked else ""),
            Column("ms\n/ step", lambda part: number(part.attacked.attack_ms, 1) if part.attacked else "", spare=3),
        ]
    columns.append(Column(axis(), _strip, "left", spare=9))
    return columns


def _progress(summary: Summary | None, colour: str) -> Text:
    return estimate(summary.safe_progress if summary else None, style=colour)


def _reference(name: str) -> Callable[[_Part], Text]:
    def value(part: _Part) -> Text:
        found = part.reference(name)
        return Text(number(found.estimate, 2) if found else MISSING, style="dim")

    return value


def _returns(summary: Summary | None) -> str:
    return number(summary.episode_return.estimate) if summary else ""


def _crashes(summary: Summary | None) -> str:
    return f"{100 * summary.crash_rate.estimate:.0f}" if summary else ""


def _strip(part: _Part) -> Text:
    points = {
        BLIND: part.reference(BEST_BLIND),
        CLEAN: part.clean.safe_progress if part.clean else None,
        ATTACKED: part.attacked.safe_progress if part.attacked else None,
    }
    return strip({colour: point for colour, point in points.items() if point and not math.isnan(point.estimate)}, STRIP)
