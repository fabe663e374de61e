"""The reports of a run: the overview of all comparisons, on one screen; and each cell by cell, with its threat model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
import pyarrow as pa
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from cavbench.core import sets
from cavbench.core.track import Track, track
from cavbench.leaderboard.comparisons.comparison import THREAT, Comparison
from cavbench.leaderboard.comparisons.naming import component, defended, varying
from cavbench.leaderboard.comparisons.reading import read_comparisons
from cavbench.leaderboard.ranking.remarks import comparison_remarks, run_remarks
from cavbench.leaderboard.terminal.cells import cell_by_cell
from cavbench.leaderboard.terminal.certified_frames import certified_frames
from cavbench.leaderboard.terminal.overview import common_sets, overview
from cavbench.leaderboard.terminal.text import (
    ATTACKED,
    BASELINE,
    CLEAN,
    MARKS,
    allowance,
    counted,
    of_frames,
    size,
    threat,
)
from cavbench.statistics.episodes import step_mean

SCREEN, AROUND, NOTES = 24, 7, 2
"""Lines of a terminal; those for the title, the headings, the gap, the folder and the prompt; and how many notes are shown that
make no number wrong."""
OUTSIDE = 1e-5
"""How far outside its set an attack may answer before a note says so: rounding."""


def run_report(records: Mapping[str, pa.Table], console: Console) -> None:
    """Print what the records of a run say, in `SCREEN` lines where the pairs are few.

    Args:
        records: by track (`cavbench.records.schema`), clean controls and baselines among them.
        console: where to print; readable from 80 columns on; wider ones add columns.
    """
    for name, table in records.items():
        comparisons = read_comparisons(table, track(name))
        below = list(_below(comparisons))
        taken = sum(len(line.wrap(console, console.width - 2)) for line in below)
        console.print(Padding(Text(size(comparisons), style="bold"), (0, 1)))
        console.print(Padding(overview(comparisons, console, SCREEN - AROUND - taken), (0, 1)))
        console.print()
        for line in below:
            console.print(Padding(line, (0, 1)))


def cells_report(records: Mapping[str, pa.Table], console: Console) -> None:
    """Print every comparison cell by cell, with all parameters, its threat model and what the numbers mean.

    Args:
        records: as of `run_report`.
        console: likewise.
    """
    for name, table in records.items():
        comparisons = read_comparisons(table, track(name))
        only_baselines = all(one.is_baseline for one in comparisons)
        for one in comparisons:
            if only_baselines or not one.is_baseline:
                console.print(Padding(heading(one), (1, 1)))
                console.print(Padding(cell_by_cell(one, console), (0, 1)))
        console.print(Padding(legend(track(name)), (1, 1)))


def _below(comparisons: Sequence[Comparison]) -> Iterator[Text]:
    """The lines below the overview: marks, threat model, notes, and where to read more."""
    own = [one for one in comparisons if one.is_attacked and not one.is_baseline]
    contrast = comparisons[0].track.contrast
    if any(one.lead for one in own) and contrast and contrast.side == "victim":
        yield marks(contrast.title)
    if common := _common_threat(own):
        yield Text(common, style="dim")
    for doubt in _together((found.about, found.text) for found in run_remarks(comparisons)):
        yield Text(doubt, style="bold yellow")
    said = [(_about(one, comparisons), remark) for one in comparisons for remark in _doubts(one)]
    notes = _together(said)
    for note in notes[:NOTES]:
        yield Text(note, style="yellow")
    if len(notes) > NOTES:
        yield Text(f"{counted(len(notes) - NOTES, 'more note')}: --cells", style="yellow")
    yield Text("`bench show FOLDER --cells` shows more; `bench help TERM` explains a column.", style="dim")


def _together(said: Iterable[tuple[str, str]]) -> list[str]:
    """A line a remark, with whom it is about."""
    notes: dict[str, list[str]] = {}
    for about, remark in said:
        notes.setdefault(remark, []).append(about)
    lines = []
    for remark, several in notes.items():
        others = f" and {len(several) - 1} more" if len(several) > 1 else ""
        lines.append(f"{several[0]}{others}: {remark}" if several[0] else remark)
    return lines


def _about(one: Comparison, comparisons: Sequence[Comparison]) -> str:
    """The attack and whom it attacks, as tables call them."""
    shown = {kind: varying(comparisons, kind) for kind in ("attack", "defense", "victim")}
    attack = f"{component(one, 'attack', shown['attack'])} on " if one.is_attacked else ""
    return f"{attack}{defended(one, shown)}"


def _common_threat(attacks: Sequence[Comparison]) -> str:
    """The threat model of all attacks, without the sets that only some of them have; empty where more than sets differs."""
    common = common_sets(attacks)
    rest = {tuple(one.identity[name] for name in THREAT[1:]) for one in attacks}
    norms = {sets.split(str(one.identity["threat_norm"]))[0] for one in attacks}
    if len(rest) != 1 or len(norms) != 1:
        return ""
    ((budget, access, queries, share),) = rest
    allowed = allowance("+".join(common), budget)
    return f"threat: {allowed}, access {access}, {queries} {attacks[0].track.queries_title}{of_frames(share)}"


def marks(baseline: str) -> Text:
    """What the marks of a comparison with a baseline mean."""
    text = Text(style="dim")
    for mark, style, meaning in (
        ("✓", "green", f"better than {baseline}"),
        ("≈", "yellow", "better, not significantly"),
        ("✗", "bold red", "not better"),
    ):
        text.append(f"{mark} ", style=f"not dim {style}").append(f"{meaning}  ")
    return text


def heading(one: Comparison) -> Table:
    """The victim, the attack with its parameters, its threat model, and what it did."""
    lines = Table.grid(padding=(0, 2, 0, 0))
    lines.add_row("victim", Text(defended(one), style="bold"))
    if one.is_attacked:
        lines.add_row("attack", Text(component(one, "attack"), style=f"bold {ATTACKED}"))
        lines.add_row("threat", Text(threat(one), style="dim"))
        for name, said in one.track.effort(one.own.column):
            lines.add_row(name, Text(said, style="dim"))
        if drawn := certified_frames(one.own.table, one.track.certificates):
            lines.add_row("certified", drawn)
    for found in comparison_remarks(one):
        lines.add_row(Text("doubt", style="bold yellow"), Text(found.text, style="bold yellow"))
    for remark in remarks(one):
        lines.add_row(Text("note", style="yellow"), Text(remark, style="yellow"))
    return lines


def remarks(one: Comparison) -> list[str]:
    """What a reader must know before trusting the numbers of a comparison."""
    contrast, found = one.track.contrast, _doubts(one)
    if contrast and contrast.side == "victim" and one.is_attacked and not one.is_baseline:
        below = [cell for cell in one.cells if (lead := one.only(cells=[cell]).lead) and lead.estimate <= 0]
        if below:
            found.append(f"no better than {contrast.title} in {len(below)} of {len(one.cells)} cells (✗)")
    return found


def _doubts(one: Comparison) -> list[str]:
    """The remarks that no column of the overview makes."""
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
    if contrast is None or one.is_baseline or contrast.side == "victim":
        return
    if one.lead is None:
        yield "no baseline attack was run beside it, so its part in the drop is unknown"
    elif one.lead.high >= 0:
        yield f"does not lower the score more than {track.baseline_kinds[one.rival].title}, which knows nothing of the victim"


def legend(track: Track) -> Text:
    """What the marks and the numbers mean."""
    text = Text(style="dim")
    contrast = track.contrast
    dots = [(CLEAN, "no attack"), (ATTACKED, "attacked")]
    dots += [(BASELINE, contrast.title)] if contrast else []
    for colour, meaning in dots:
        text.append(f"{MARKS[colour]} ", style=f"not dim {colour}").append(f"{meaning}   ")
    if contrast and contrast.side == "victim":
        text.append("\n").append_text(marks(contrast.title))
    scores = (
        f"Scores: mean over {track.run}s, cells and {track.episode[1]}, with the 95 % interval for other {track.run}s and other "
        f"{track.episode[1]}. Attacked, clean and baselines have the same {track.episode[1]}."
    )
    said = (track.legend, "kept: retention, attacked / clean score.", scores)
    return text.append("\n" + " ".join(filter(None, said)))
