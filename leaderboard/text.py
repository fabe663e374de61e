"""How the numbers of a report are written: estimates with their intervals, shares, parameters, threat models."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Protocol

from rich.text import Text

from bench.statistics.estimates import Interval
from leaderboard.pairs import Pair, parameters

MISSING = "—"
CLEAN, ATTACKED, BLIND = "cyan", "yellow", "bright_black"
"""The colours of a report, and their marks in a strip."""
MARKS = {CLEAN: "○", ATTACKED: "●", BLIND: "┃"}


def number(value: float | None, digits: int = 0) -> str:
    """A number with so many decimals; an em dash where there is none."""
    return MISSING if value is None or math.isnan(value) else f"{value:.{digits}f}"


def share(value: float | None) -> str:
    """A share in [0, 1] as a percentage."""
    return MISSING if value is None or math.isnan(value) else f"{100 * value:.0f} %"


def estimate(found: Interval | None, *, digits: int = 2, style: str = "") -> Text:
    """An estimate, and its interval in a quieter voice."""
    if found is None or math.isnan(found.estimate):
        return Text(MISSING, style="dim")
    written = Text.assemble((f"{found.estimate:.{digits}f}", f"{style} bold".strip()))
    if not math.isnan(found.low):
        written.append(f" {_short(found.low, digits)}–{_short(found.high, digits)}", style="dim")
    return written


def _short(value: float, digits: int) -> str:
    """A bound without the zero before the point: `.58`."""
    written = f"{value:.{digits}f}"
    return written.replace("0.", ".", 1) if written.startswith(("0.", "-0.")) and digits else written


def arrow(clean: str, attacked: str) -> Text:
    """From the unattacked value to the attacked one; either may be empty."""
    if not (clean and attacked):
        return Text(clean or attacked)
    return Text.assemble((clean, CLEAN), (" → ", "dim"), (attacked, ATTACKED))


def change(found: Interval | None, *, digits: int = 2) -> Text:
    """A signed difference; dim where its interval holds 0."""
    if found is None or math.isnan(found.estimate):
        return Text(MISSING, style="dim")
    return Text(signed(found.estimate, digits), style="dim" if 0 in found else "bold")


def bounds(found: Interval, *, digits: int = 2) -> Text:
    """The interval of a signed difference."""
    if math.isnan(found.low):
        return Text("")
    return Text(f"{signed(found.low, digits)}…{signed(found.high, digits)}".replace("0.", "."), style="dim")


def signed(value: float, digits: int) -> str:
    """A difference with its sign."""
    return f"{value:+.{digits}f}".replace("-", "−")


def verdict(lead: Interval | None) -> Text:
    """Whether the attacked victim beats the best blind policy: yes, not told apart, no."""
    if lead is None:
        return Text("")
    if lead.estimate <= 0:
        return Text("✗", style="bold red")
    return Text("≈", style="yellow") if 0 in lead else Text("✓", style="green")


def strip(points: Mapping[str, Interval | None], width: int) -> Text:
    """Estimates on an axis from 0 to 1, with their intervals as lines: a colour of this module a point."""
    cells = [("·", "bright_black")] * width

    def column(value: float) -> int:
        return min(max(int(value * width), 0), width - 1)

    for style, point in points.items():
        if point is not None and not math.isnan(point.low):
            for place in range(column(point.low), column(point.high) + 1):
                cells[place] = ("─", style)
    for style, point in points.items():
        if point is not None and not math.isnan(point.estimate):
            cells[column(point.estimate)] = (MARKS[style], f"bold {style}")
    return Text.assemble(*cells)


class Identified(Protocol):
    """A pair of either track."""

    @property
    def identity(self) -> Mapping[str, object]:
        """Names and parameters of its components."""


def varying(pairs: Sequence[Identified], column: str) -> set[str]:
    """The parameters of a component that the pairs do not all share, looking only at pairs with the same component."""
    by_name: dict[object, list[dict[str, object]]] = {}
    for pair in pairs:
        if column in pair.identity:
            by_name.setdefault(pair.identity[column], []).append(parameters(pair.identity[f"{column}_params"]))
    return {
        name
        for sets in by_name.values()
        for name in set().union(*sets)
        if len({repr(each.get(name)) for each in sets}) > 1
    }


def labels(driven: Sequence[tuple[Identified, int]], column: str) -> dict[tuple[object, object], str]:
    """A label for each component of a kind, by name and parameters as in the records.

    It is the name with the parameters in which components of this name differ, but for those in which it is as most of them.

    Args:
        driven: pairs, each with how many episodes it is of.
        column: `attack`, `defense` or `victim`.
    """
    names = varying([pair for pair, _ in driven], column)
    episodes: dict[tuple[object, str], Counter[str]] = {}
    for pair, count in driven:
        for name, value in parameters(pair.identity[f"{column}_params"]).items():
            episodes.setdefault((pair.identity[column], name), Counter())[repr(value)] += count
    usual = {key: value for key, counts in episodes.items() for value, n in counts.items() if 2 * n > counts.total()}
    found = {}
    for pair, _ in driven:
        component, params = pair.identity[column], pair.identity[f"{column}_params"]
        words = [
            f"{name}={value}"
            for name, value in parameters(params).items()
            if name in names and usual.get((component, name)) != repr(value)
        ]
        found[component, params] = " ".join([str(component), *words])
    return found


def component(pair: Identified, column: str, shown: set[str] | None = None) -> str:
    """A component's name with the parameters in `shown` (all of them by default)."""
    found = parameters(pair.identity[f"{column}_params"])
    words = [f"{name}={value}" for name, value in found.items() if shown is None or name in shown]
    return " ".join([str(pair.identity[column]), *words])


def threat(pair: Pair) -> str:
    """The threat model of a pair in one sentence."""
    identity = pair.identity
    if identity.get("attack", "none") == "none":
        return "nothing is attacked"
    budget = float(str(identity["threat_budget"]))
    if identity["threat_norm"] == "relative":
        # Imported here: with torch, that takes seconds, and a leaderboard writes no such sentence.
        from bench.driving.threat import FLOORS

        floors = ", ".join(f"{name} {floor * budget / 0.1:g} {_unit(name)}" for name, floor in FLOORS.items())
        bounds = f"each measured value may be off by {100 * budget:g} % of itself, or by its floor ({floors})"
    else:
        bounds = f"each measured value may be off by {budget:g} on the [-1, 1] scale"
    return (
        f"{identity['threat_norm']} {budget:g}: {bounds}; access {identity['threat_access']}, "
        f"at most {identity['threat_queries']} queries a step; presence cannot be forged"
    )


def _unit(feature: str) -> str:
    return "m/s" if feature.startswith("v") else "m"
