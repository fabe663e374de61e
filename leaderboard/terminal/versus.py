"""A comparison of two sources as a table on the terminal, and in Markdown."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from cavbench.core.track import track
from cavbench.errors import in_markdown
from cavbench.leaderboard.comparisons.versus import Line, Versus
from cavbench.leaderboard.terminal.layout import Column, Section, cell_name, fitted
from cavbench.leaderboard.terminal.text import bounds, change, counted, number
from cavbench.statistics.paired import LEVEL

STYLES = {"better": "green", "worse": "bold red", "same": "dim"}
WORDS = {"better": "✓ better", "worse": "✗ worse", "same": "≈"}
MOST_NAMED, MOST_CELLS = 5, 8
"""Rows that a sentence names, and cells that are shown without being asked for."""


def print_versus(found: Versus, console: Console, *, cells: bool = False) -> None:
    """Print the rows, and the cells that changed.

    Args:
        found: the comparison.
        console: where to print.
        cells: print every cell.
    """
    if found.rows:
        console.print(Padding(Text(title(found), style="bold"), (0, 1)))
        console.print(Padding(fitted(_columns("attack"), _sections(found.rows), console), (0, 1)))
        shown = found.cells if cells else _most_changed(found)
        if shown:
            console.print(Padding(fitted(_columns("cell"), _sections(shown), console), (1, 1, 0, 1)))
        console.print()
    for line in below(found):
        console.print(Padding(Text(line, style="dim"), (0, 1)))


def _most_changed(found: Versus) -> list[Line]:
    """Of the cells that changed those that changed most, in their order."""
    changed = [line for line in found.cells if line.verdict != "same"]
    most = sorted(changed, key=lambda line: -abs(line.difference.estimate))[:MOST_CELLS]
    return [line for line in changed if line in most]


def _columns(of: str) -> list[Column[Line]]:
    def named(line: Line) -> str:
        return f"  {line.attack}" if line.cell is None else f"  {line.attack} | {cell_name(line.cell)}"

    return [
        Column(of, named, "left", folds=True),
        Column("A", lambda line: number(line.first.estimate, 3)),
        Column("B", lambda line: number(line.second.estimate, 3)),
        Column("B − A", lambda line: change(line.difference, digits=3)),
        Column("[95 %]", lambda line: bounds(line.difference, digits=3), spare=1),
        Column("p", lambda line: p(line.p), spare=2),
        Column("", lambda line: Text(WORDS[line.verdict], style=STYLES[line.verdict]), "left"),
    ]


def _sections(lines: Sequence[Line]) -> list[Section[Line]]:
    together: dict[str, list[Line]] = {}
    for line in lines:
        together.setdefault(line.defended, []).append(line)
    return [Section(own, Text(name, style="bold")) for name, own in together.items()]


def title(found: Versus) -> str:
    """What is compared, and on how much."""
    line = found.rows[0]
    of = track(line.track)
    sizes = {one.shape for one in found.rows}
    size = "several sizes" if len(sizes) > 1 else _size(line)
    return f"{of.metric_title}, A: {found.names[0]}, B: {found.names[1]}; {size}"


def _size(line: Line) -> str:
    of = track(line.track)
    runs, cells, scenarios = line.shape
    return f"{counted(cells, 'cell')} of {counted(scenarios, *of.episode)}, {counted(runs, of.run)}"


def below(found: Versus) -> Iterator[str]:
    """The verdict and what a reader must know, in sentences."""
    for name in ("worse", "better"):
        lines = [line for line in found.rows if line.verdict == name]
        if lines:
            yield f"B is significantly {name}: {_named(lines)}."
    if found.rows and all(line.verdict == "same" for line in found.rows):
        yield "No row is significantly better or worse."
    if found.rows:
        cells = sum(line.verdict != "same" for line in found.cells)
        more = "; the table has those that changed most, --cells has all" if cells > MOST_CELLS else ""
        yield f"{cells} of {len(found.cells)} cells differ significantly{more}."
        yield (
            f"Differences are paired by training seed, cell and scenario. p is adjusted (Holm): any of {len(found.rows)} rows is "
            f"called different by chance in {100 * LEVEL:g} % of comparisons at most, and likewise any of the cells. "
            "Each interval stands for itself."
        )
    yield from (f"{line[:1].upper()}{line[1:]}." for line in (*found.remarks, *found.left_out[:MOST_NAMED]))
    if len(found.left_out) > MOST_NAMED:
        yield f"{len(found.left_out) - MOST_NAMED} more lines of what is left out: --json."


def _named(lines: Sequence[Line]) -> str:
    """Rows in a sentence, as many as fit."""
    together = {
        str(section.title): [line.attack for line in section.subjects] for section in _sections(lines[:MOST_NAMED])
    }
    several = f" and {len(lines) - MOST_NAMED} more" if len(lines) > MOST_NAMED else ""
    return "; ".join(f"{name} ({', '.join(attacks)})" for name, attacks in together.items()) + several


def p(value: float) -> str:
    """A p-value in at most five characters."""
    return "—" if math.isnan(value) else "<.001" if value < 0.001 else f"{value:.3f}"


def markdown(found: Versus) -> str:
    """The same in Markdown, for a summary of a job or a pull request."""
    lines = []
    if found.rows:
        lines += [f"### {in_markdown(title(found))}", ""]
        lines += _table(found.rows, "attack")
        if changed := _most_changed(found):
            lines += ["", "<details><summary>The cells that changed most</summary>", ""]
            lines += [*_table(changed, "attack and cell"), "", "</details>"]
        lines.append("")
    lines += [f"{in_markdown(line)}  " for line in below(found)]
    return "\n".join(lines) + "\n"


def _table(lines: Sequence[Line], heading: str) -> list[str]:
    rows = [f"| defended victim | {heading} | A | B | B − A | 95 % | p | |", "|---|---|--:|--:|--:|---|--:|---|"]
    for line in lines:
        attack = line.attack if line.cell is None else f"{line.attack}, {cell_name(line.cell)}"
        interval = (
            "—" if math.isnan(line.difference.low) else f"{line.difference.low:+.3f} … {line.difference.high:+.3f}"
        )
        values = (
            line.defended,
            attack,
            number(line.first.estimate, 3),
            number(line.second.estimate, 3),
            f"{line.difference.estimate:+.3f}",
            interval,
            p(line.p),
            WORDS[line.verdict],
        )
        rows.append(f"| {' | '.join(map(in_markdown, values))} |")
    return rows
