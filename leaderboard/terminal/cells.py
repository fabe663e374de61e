"""A comparison cell by cell, grouped by the perceptual axes: clean beside attacked beside the baselines."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table
from rich.text import Text

from cavbench.core.track import Baseline, Measure
from cavbench.leaderboard.comparisons.comparison import Comparison
from cavbench.leaderboard.terminal.columns import measure_columns, written
from cavbench.leaderboard.terminal.layout import STRIP, Column, Section, axis, cell_heading, cell_rows, fitted
from cavbench.leaderboard.terminal.text import (
    ATTACKED,
    BASELINE,
    CLEAN,
    MISSING,
    arrow,
    estimate,
    number,
    share,
    strip,
    verdict,
)
from cavbench.statistics.episodes import measured
from cavbench.statistics.estimates import Interval


@dataclass(frozen=True)
class Part:
    """A named part of a comparison.

    Args:
        name: of its row.
        of: the comparison in the cells, or at the place, of the row.
        rival: the baseline that the whole comparison is compared with.
    """

    name: Text
    of: Comparison
    rival: str

    @property
    def clean(self) -> Interval | None:
        """The clean score."""
        return self.of.clean_score

    @property
    def attacked(self) -> Interval | None:
        """The score under attack."""
        return self.of.score if self.of.is_attacked else None


def cell_by_cell(one: Comparison, console: Console) -> Table:
    """A row a cell, and rows for each perceptual condition, each place and the whole."""
    return fitted(_columns(one), list(_sections(one)), console)


def _sections(one: Comparison) -> Iterator[Section[Part]]:
    groups = cell_rows(one.cells, one.axes)
    places = one.places if len(one.places) > 1 else {}
    for rows in groups:
        yield Section([Part(name, one.only(cells=cells), one.rival) for name, cells in rows])
    if places:
        yield Section([Part(Text(place), one.only(seeds=seeds), one.rival) for place, seeds in places.items()])
    alone = len(groups) == 1 and (len(groups[0]) == 1 or len(groups[0]) > len(one.cells))
    if places or not alone:
        yield Section([Part(Text("all", style="bold"), one, one.rival)])


def _columns(one: Comparison) -> list[Column[Part]]:
    track = one.track
    columns: list[Column[Part]] = [
        Column(cell_heading(one.axes), lambda part: part.name, "left"),
        Column(f"{track.metric_title}\nclean [95 %]", lambda part: estimate(part.clean, style=CLEAN), "left"),
    ]
    if one.is_attacked:
        columns += [
            Column("\nattacked", lambda part: estimate(part.attacked, style=ATTACKED), "left"),
            Column("\nkept", lambda part: share(part.of.retained)),
        ]
        if track.contrast and track.contrast.side == "victim" and one.baselines:
            columns.append(Column(" \n ", lambda part: verdict(part.of.lead)))
    for name in one.baselines:
        known = track.baseline_kinds.get(name, Baseline(title=name, heading=f"\n{name}"))
        columns.append(Column(known.heading, _baseline(name), spare=known.spare))
    columns += measure_columns([one], "cells", _measure)
    return [*columns, Column(axis(track.metric_title), _strip, "left", spare=9)]


def _baseline(name: str) -> Callable[[Part], Text]:
    def value(part: Part) -> Text:
        found = part.of.baseline_scores.get(name)
        return Text(number(found.estimate, 2) if found else MISSING, style="dim")

    return value


def _measure(measure: Measure) -> Callable[[Part], Text | str]:
    """Without an attack and with it; of an attack's own measures the latter alone."""

    def value(part: Part) -> Text | str:
        one = part.of
        if measure.of_attack:
            return written(measure, one.measured(measure))
        both = (one.clean, one.attacked)
        texts = [str(written(measure, measured(episodes, measure))) if episodes else "" for episodes in both]
        return arrow(*(text.removesuffix(" %") for text in texts))

    return value


def _strip(part: Part) -> Text:
    scores = part.of.baseline_scores
    return strip({BASELINE: scores.get(part.rival), CLEAN: part.clean, ATTACKED: part.attacked}, STRIP)
