"""How reports write numbers: estimates with their intervals, shares, differences, sizes, threat models."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from rich.text import Text

from cavbench.core import sets
from cavbench.leaderboard.comparisons.comparison import THREAT, Comparison
from cavbench.statistics.estimates import Interval

MISSING = "—"
CLEAN, ATTACKED, BASELINE = "cyan", "yellow", "bright_black"
"""The colours of a report, and their marks in a strip."""
MARKS = {CLEAN: "○", ATTACKED: "●", BASELINE: "┃"}


def number(value: float | None, digits: int = 0) -> str:
    """A number with so many decimals; an em dash where there is none."""
    return MISSING if value is None or math.isnan(value) else f"{value:.{digits}f}"


def share(value: float | None) -> str:
    """A share in [0, 1] as a percentage."""
    return MISSING if value is None or math.isnan(value) else f"{100 * value:.0f} %"


def estimate(found: Interval | None, *, digits: int = 2, style: str = "") -> Text:
    """An estimate, and its interval in a dim colour."""
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
    """Whether the attacked victim scores above its baseline: yes, no significant difference, no."""
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


def size(comparisons: Sequence[Comparison]) -> str:
    """How much was driven: "standard-v2: 18 cells of 20 scenarios, 3 training seeds"; after a race "10 to 20 scenarios"."""
    track = comparisons[0].track
    counts = {one.own.shape[1] for one in comparisons}
    if len(counts) > 1:
        return "several grids"
    episodes = sorted({one.own.shape[2] for one in comparisons})
    grids = sorted({grid for one in comparisons for grid in one.own.table["grid"].unique().to_pylist()})
    runs = max(len(one.own.runs) for one in comparisons)
    least = f"{episodes[0]} to " if len(episodes) > 1 else ""
    driven = f"{counted(counts.pop(), 'cell')} of {least}{counted(episodes[-1], *track.episode)}"
    return f"{' and '.join(grids)}: {driven}, {counted(runs, track.run)}"


def counted(number: int, one: str, several: str = "") -> str:
    """A number with its noun."""
    return f"{number} {one if number == 1 else several or one + 's'}"


def threat(one: Comparison) -> str:
    """The threat model of a comparison in one sentence."""
    if not one.is_attacked:
        return "nothing is attacked"
    norm, budget, access, queries, share = (one.identity[name] for name in THREAT)
    allowed = one.track.allowed(norm, budget, one.facts)
    plain, _ = sets.split(norm)
    return (
        f"{plain} {budget:g}: {allowed}; access {access}, at most {queries} {one.track.queries_title}{of_frames(share)}"
    )


def allowance(norm: str, budget: float) -> str:
    """What an attack may do: the perturbation set with its size, then the other sets."""
    plain, others = sets.split(norm)
    return ", ".join((f"{plain} {budget:g}", *others))


def of_frames(share: float) -> str:
    """What `threat.share` adds to a threat model in words: nothing if every frame may be perturbed."""
    return "" if share == 1 else f", {100 * share:g} % of the frames"
