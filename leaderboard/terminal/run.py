"""`bench run`'s report: the overview of all comparisons, then each cell by cell, with its threat model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import pyarrow as pa
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from bench.plugins.track import Track, track
from bench.statistics.episodes import step_mean
from leaderboard.comparisons.comparison import Comparison
from leaderboard.comparisons.naming import component, defended
from leaderboard.comparisons.reading import read_comparisons
from leaderboard.terminal.cells import cell_by_cell
from leaderboard.terminal.overview import overview
from leaderboard.terminal.text import ATTACKED, BASELINE, CLEAN, MARKS, counted, size, threat

OUTSIDE = 1e-5
"""How far outside its set an attack may answer before a note says so: rounding."""


def run_report(records: Mapping[str, pa.Table], console: Console) -> None:
    """Print what the records of a run say.

    Args:
        records: by track (`bench.records.schema`), clean controls and baselines among them.
        console: where to print; readable from 80 columns on; wider ones add columns.
    """
    for name, table in records.items():
        comparisons = read_comparisons(table, track(name))
        console.print(Padding(Text(size(comparisons), style="bold"), (1, 1)))
        console.print(Padding(overview(comparisons, console), (0, 1)))
        only_baselines = all(one.is_baseline for one in comparisons)
        for one in comparisons:
            if only_baselines or not one.is_baseline:
                console.print(Padding(heading(one), (1, 1)))
                console.print(Padding(cell_by_cell(one, console), (0, 1)))
        console.print(Padding(legend(track(name)), (1, 1)))


def heading(one: Comparison) -> Table:
    """The victim, the attack with its parameters, its threat model, and what it did."""
    lines = Table.grid(padding=(0, 2, 0, 0))
    lines.add_row("victim", Text(defended(one), style="bold"))
    if one.is_attacked:
        lines.add_row("attack", Text(component(one, "attack"), style=f"bold {ATTACKED}"))
        lines.add_row("threat", Text(threat(one), style="dim"))
        for name, said in one.track.effort(one.own.column):
            lines.add_row(name, Text(said, style="dim"))
    for remark in remarks(one):
        lines.add_row(Text("note", style="yellow"), Text(remark, style="yellow"))
    return lines


def remarks(one: Comparison) -> list[str]:
    """What a reader must know before trusting the numbers of a comparison."""
    found = list(_of_the_attack(one)) if one.is_attacked else []
    left_out = sum(episodes.left_out for episodes in (one.own, one.clean if one.is_attacked else None) if episodes)
    if left_out:
        are = f"{counted(left_out, *one.track.episode)} {'is' if left_out == 1 else 'are'} left out"
        found.append(f"{are}: not every {one.track.run} has driven their scenario yet")
    return found


def _of_the_attack(one: Comparison) -> Iterator[str]:
    track, hertz = one.track, float(one.facts.get("decision_hz") or 0)
    if track.excess and (excess := float(np.max(one.own.column(track.excess)))) > OUTSIDE:
        yield f"the attack answered up to {excess:.2g} outside its perturbation set; it was projected back"
    if track.step_ms and hertz and step_mean(one.own, track.step_ms) > 1000 / hertz:
        yield f"slower than the {1000 / hertz:.0f} ms between two decisions: it cannot run in real time"
    if one.clean is None:
        yield "the clean control was not driven on these scenarios"
    contrast = track.contrast
    if contrast is None or one.is_baseline:
        return
    if contrast.side == "victim":
        below = [cell for cell in one.cells if (lead := one.only(cells=[cell]).lead) and lead.estimate <= 0]
        if below:
            yield f"no better than {contrast.title} in {len(below)} of {len(one.cells)} cells (✗)"
    elif one.lead is None:
        yield "compared with no baseline attack, which knows nothing of the victim: part of the drop may be its effect"
    elif one.lead.high >= 0:
        yield f"does not lower the score more than {track.baseline_kinds[one.rival].title}, which knows nothing of the victim"


def legend(track: Track) -> Text:
    """What the marks and the numbers mean."""
    text = Text(style="dim")
    contrast = track.contrast
    marks = [(CLEAN, "no attack"), (ATTACKED, "attacked")]
    marks += [(BASELINE, contrast.title)] if contrast else []
    for colour, meaning in marks:
        text.append(f"{MARKS[colour]} ", style=f"not dim {colour}").append(f"{meaning}   ")
    if contrast and contrast.side == "victim":
        text.append("\n")
        for mark, style, meaning in (
            ("✓", "green", f"better than {contrast.title} of the cell"),
            ("≈", "yellow", "no significant difference"),
            ("✗", "bold red", "not better: its input is worth nothing"),
        ):
            text.append(f"{mark} ", style=f"not dim {style}").append(f"{meaning}   ")
    scores = (
        f"Scores: mean over {track.run}s, cells and {track.episode[1]}, with the 95 % interval for other {track.run}s and other "
        f"{track.episode[1]}. Attacked, clean and baselines have the same {track.episode[1]}."
    )
    said = (track.legend, "kept: retention, attacked / clean score.", scores)
    return text.append("\n" + " ".join(filter(None, said)))
