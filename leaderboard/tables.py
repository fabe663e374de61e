"""`bench run`'s report: the overview of all pairs, then each pair cell by cell, with the threat model it is under."""

from __future__ import annotations

from collections.abc import Mapping

import pyarrow as pa
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from bench.plugins.contracts import Track
from bench.statistics.episodes import CONTROL_PERIOD_MS, step_mean
from leaderboard.approach_tables import approach_report
from leaderboard.cells import cell_by_cell
from leaderboard.overview import overview, size
from leaderboard.pairs import Pair, read_pairs
from leaderboard.text import ATTACKED, BLIND, CLEAN, MARKS, component, number, threat


def run_report(records: Mapping[Track, pa.Table], console: Console) -> None:
    """Print what the records of a run say.

    Args:
        records: by track (`bench.records.store.SCHEMAS`), clean controls and references among them.
        console: where to print; readable from 80 columns on; wider ones add columns.
    """
    if "driving" in records:
        driving_report(records["driving"], console)
    if "detection" in records:
        approach_report(records["detection"], console)


def driving_report(records: pa.Table, console: Console) -> None:
    """Print what the records of a run of the driving track say."""
    pairs = read_pairs(records)
    console.print(Padding(Text(size(pairs), style="bold"), (1, 1)))
    console.print(Padding(overview(pairs, console), (0, 1)))
    for pair in pairs:
        console.print(Padding(heading(pair), (1, 1)))
        console.print(Padding(cell_by_cell(pair, console), (0, 1)))
    console.print(Padding(legend(), (1, 1)))


def heading(pair: Pair) -> Table:
    """Who attacks whom with what parameters, under which threat model, and how far the attack went."""
    title = Text(component(pair, "victim", set()), style="bold")
    if pair.identity["defense"] != "none":
        title.append(f" + {component(pair, 'defense')}")
    lines = Table.grid(padding=(0, 2, 0, 0))
    lines.add_row("victim", title)
    if pair.attacked:
        metres, speed = (number(step_mean(pair.attacked, name), 2) for name in ("linf_m", "linf_mps"))
        lines.add_row("attack", Text(component(pair, "attack"), style=f"bold {ATTACKED}"))
        lines.add_row("threat", Text(threat(pair), style="dim"))
        lines.add_row("moved", Text(f"{metres} m and {speed} m/s, the largest of a step, on average", style="dim"))
    for remark in remarks(pair):
        lines.add_row(Text("note", style="yellow"), Text(remark, style="yellow"))
    return lines


def remarks(pair: Pair) -> list[str]:
    """What a reader must know before trusting the numbers of a pair."""
    found = []
    if pair.attacked and pair.attacked_summary:
        excess = float(pair.attacked.column("excess_max").max())
        if excess > 1e-5:
            found.append(f"the attack answered up to {excess:.2g} outside its perturbation set; it was projected back")
        if pair.attacked_summary.attack_ms > CONTROL_PERIOD_MS:
            found.append(f"slower than the {CONTROL_PERIOD_MS:.0f} ms between two decisions: it cannot run on the road")
        if pair.clean is None:
            found.append("the clean control was not driven on these scenarios")
        below = [cell for cell in pair.cells if (lead := pair.only([cell]).lead) and lead.estimate <= 0]
        if below:
            found.append(f"no better than the best blind policy in {len(below)} of {len(pair.cells)} cells (✗)")
    left_out = sum(drive.left_out for drive in (pair.attacked, pair.clean) if drive)
    if left_out:
        found.append(f"{left_out} episodes are left out: not every training seed has driven their scenario yet")
    return found


def legend() -> Text:
    """What the marks and the numbers mean."""
    text = Text(style="dim")
    for colour, meaning in ((CLEAN, "no attack"), (ATTACKED, "attacked"), (BLIND, "best blind policy, reference")):
        text.append(f"{MARKS[colour]} ", style=f"not dim {colour}").append(f"{meaning}   ")
    text.append("\n")
    for mark, style, meaning in (
        ("✓", "green", "beats the best blind policy of the cell"),
        ("≈", "yellow", "cannot be told from it"),
        ("✗", "bold red", "does not beat it: it would drive better with its eyes shut"),
    ):
        text.append(f"{mark} ", style=f"not dim {style}").append(f"{meaning}   ")
    return text.append(
        "\nsafe progress: 0 if the episode crashes or leaves the road, else mean progress; interquartile mean over "
        "training seeds and cells, 95 % bootstrap interval. kept: attacked / clean. success: share of steps whose "
        "decision the attack changed. Attacked, clean and blind drive the same scenarios."
    )
