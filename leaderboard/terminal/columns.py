"""The columns that a track's own measures make in tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

from rich.text import Text

from cavbench.core.track import Measure
from cavbench.leaderboard.comparisons.comparison import Comparison, mean
from cavbench.leaderboard.terminal.layout import Column
from cavbench.leaderboard.terminal.text import estimate, number, share
from cavbench.statistics.estimates import Interval

Subject = TypeVar("Subject")


def measure_columns(
    comparisons: Sequence[Comparison],
    table: str,
    value: Callable[[Measure], Callable[[Subject], Text | str]],
) -> list[Column[Subject]]:
    """A column for each measure of a track, as far as the records have it.

    Args:
        comparisons: of the track, that the table is of; measures of an attack are there where one of them has an attack.
        table: `overview` or `cells`.
        value: makes what a column of a measure shows.
    """
    first = comparisons[0]
    crowded = table == "overview" and any(len(one.cells) > 1 for one in comparisons)
    attacked = any(one.is_attacked for one in comparisons)
    return [
        Column(
            _heading(measure, table).format_map(first.facts),
            value(measure),
            "left" if measure.with_interval and table == "overview" else "right",
            # The overview's worst cell is worth more than any measure but the rate of failure.
            spare=measure.spare or int(crowded and measure.column != first.track.failure),
        )
        for measure in sorted(first.track.measures, key=lambda one: crowded and one.column != first.track.failure)
        if measure.tables in (table, "both") and (attacked or not measure.of_attack) and _known(measure, comparisons)
    ]


def _known(measure: Measure, comparisons: Sequence[Comparison]) -> bool:
    """Whether any record has the measure; older ones may lack it."""
    return any(not math.isnan(mean(one.own.table, measure.column)) for one in comparisons)


def _heading(measure: Measure, table: str) -> str:
    """With the unit of a share, unless the overview has it behind every number."""
    if (table == "overview" and not measure.with_interval) or measure.unit != "share" or measure.of_attack:
        return measure.heading
    return f"{measure.heading[1:]}\n%" if measure.heading.startswith("\n") else f"{measure.heading} %"


def written(measure: Measure, found: Interval, *, with_interval: bool = False) -> Text | str:
    """The number of a measure in its unit."""
    if with_interval:
        factor = 100 if measure.unit == "share" else 1
        scaled = Interval(*(factor * value for value in (found.estimate, found.low, found.high)))
        return estimate(scaled, digits=measure.digits)
    return share(found.estimate) if measure.unit == "share" else number(found.estimate, measure.digits)
