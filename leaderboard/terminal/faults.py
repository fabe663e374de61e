"""What faults without an adversary do to each defended victim: `bench report faults`, a second column beside the attacks."""

from __future__ import annotations

from collections.abc import Mapping

import pyarrow as pa
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from cavbench.errors import UserError
from cavbench.leaderboard.comparisons.reading import read_tracks
from cavbench.leaderboard.ranking.faults import FaultRow, fault_rows
from cavbench.leaderboard.terminal.layout import Column, Section, fitted
from cavbench.leaderboard.terminal.text import number, share

MEANING = (
    "mean, worst and crashed: over all faults that were driven. without: the same scenarios without a fault. "
    "IDM: the score of the world's own driver there, which sees no sensor; of IDM: the mean as a share of it."
)


def faults_report(records: Mapping[str, pa.Table], console: Console) -> None:
    """Print the scores under faults.

    Args:
        records: by track (`cavbench.records.schema`).
        console: where to print.

    Raises:
        UserError: if no fault was driven.
    """
    rows = fault_rows(read_tracks(records))
    if not rows:
        raise UserError("no fault was driven: bench run attack=faults")
    columns: list[Column[FaultRow]] = [
        Column("\ndefended victim", lambda one: one.name, "left", folds=True),
        Column("\nfaults", lambda one: str(one.faults), spare=2),
        Column("\nsuite", lambda one: one.suite, "left", spare=4),
        Column("\nwithout", lambda one: number(one.clean, 2)),
        Column("\nmean", lambda one: number(one.mean, 2)),
        Column("\nworst", lambda one: number(one.worst, 2)),
        Column("worst\nfault", lambda one: one.hardest, "left", spare=1),
        Column("\ncrashed", lambda one: share(one.crashed)),
        Column("crashed,\nworst", lambda one: share(one.worst_crashed)),
        Column("\nIDM", lambda one: number(one.idm, 2)),
        Column("of\nIDM", lambda one: share(one.of_idm), spare=3),
    ]
    console.print(Padding(fitted(columns, [Section(rows)], console), (0, 1)))
    console.print(Padding(Text(MEANING, style="dim"), (0, 1)))
