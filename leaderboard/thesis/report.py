"""`bench report thesis`: the tables of the thesis, number by number beside ours."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import pyarrow as pa
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from cavbench.core.track import track
from cavbench.detection.track import DetectionTrack
from cavbench.driving.track import DrivingTrack
from cavbench.leaderboard.thesis import patches, policies
from cavbench.leaderboard.thesis.numbers import PUBLISHED, THESIS, Beside, printed
from cavbench.records.schema import schema


def thesis_report(records: Mapping[str, pa.Table], console: Console) -> None:
    """Print the thesis' tables beside ours.

    Args:
        records: the user's, by track; where they have none, those published with the package are read.
        console: where to print; readable from 100 columns on.
    """
    numbers = printed()
    driven = {
        name: records.get(name, schema(track(name)).empty_table()) for name in (DetectionTrack.name, DrivingTrack.name)
    }
    source = Text.assemble(
        (numbers["source"], f"bold {THESIS}"), f"\nBeside it ours.{PUBLISHED} published with the package, not run here."
    )
    console.print(Padding(source, (1, 1)))
    chapter = patches.tables(numbers, driven[DetectionTrack.name], console)
    _print_chapter("Chapter 3", patches.heading(), chapter, console)
    chapter = policies.tables(numbers, driven[DrivingTrack.name])
    _print_chapter("Chapter 4", policies.heading(numbers["max_reward"]), chapter, console)


def _print_chapter(name: str, heading: Text, tables: Iterable[Beside], console: Console) -> None:
    console.print(Padding(Text.assemble((f"{name}. ", "bold"), heading), (0, 1, 1, 1)))
    for beside in tables:
        console.print(Padding(Text(beside.section["title"], style="bold"), (0, 1)))
        console.print(Padding(beside.table, (0, 1)))
        console.print()
        for note in beside.notes:
            console.print(Padding(note, (0, 1)))
        for check in beside.section["check"]:
            console.print(Padding(Text(f"thesis: {check}", style=f"dim {THESIS}"), (0, 1)))
        for command in beside.missing:
            console.print(Text.assemble((" missing: ", "yellow"), command), soft_wrap=True)
        console.print()
