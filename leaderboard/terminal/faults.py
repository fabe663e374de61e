"""What faults without an adversary do to each defended victim: `bench report faults`, a second column beside the attacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from cavbench.errors import UserError
from cavbench.leaderboard.comparisons.comparison import Comparison
from cavbench.leaderboard.comparisons.reading import read_tracks
from cavbench.leaderboard.terminal.layout import Column, Section, fitted
from cavbench.leaderboard.terminal.text import number, share

FAULT = "fault"
MEANING = (
    "mean, worst and crashed: over all faults that were driven. without: the same scenarios without a fault. "
    "IDM: the score of the world's own driver there, which sees no sensor; of IDM: the mean as a share of it."
)


@dataclass(frozen=True)
class FaultRow:
    """A defended victim under faults: scores, crash rates in [0, 1], and the worst fault's parameters.

    Args:
        name: defence and victim.
        faults: number of faults.
        clean, mean, worst: scores without a fault, over all faults, and under the worst.
        crashed, worst_crashed: crash rate over all faults, and under the worst of them.
        idm: score of IDM on the same scenarios; NaN where it was not driven.
        hardest: what the worst fault is.
    """

    name: str
    faults: int
    clean: float
    mean: float
    worst: float
    crashed: float
    worst_crashed: float
    idm: float
    hardest: str

    @classmethod
    def of(cls, found: Sequence[Comparison]) -> FaultRow:
        """The row of some comparisons of one defended victim, each under another fault."""
        first = found[0]
        metric, failure = first.track.metric, first.track.failure
        scores = [float(one.scores.mean()) for one in found]
        crashes = [float(one.own.column(failure).mean()) for one in found]
        idm = first.baselines.get(first.track.safe_driver)
        defense, victim = str(first.identity["defense"]), str(first.identity["victim"])
        hardest = found[int(np.argmin(scores))].settings
        return cls(
            name=victim if defense == "none" else f"{defense} + {victim}",
            faults=len(found),
            clean=float(first.clean.column(metric).mean()) if first.clean else np.nan,
            mean=float(np.mean(scores)),
            worst=min(scores),
            crashed=float(np.mean(crashes)),
            worst_crashed=max(crashes),
            idm=float(idm.column(metric).mean()) if idm else np.nan,
            hardest=f"{hardest['attack.mode']} {hardest['attack.severity']}",
        )

    @property
    def of_idm(self) -> float:
        """The mean score as a share of IDM's."""
        return self.mean / self.idm if self.idm else np.nan


def fault_rows(comparisons: Sequence[Comparison]) -> list[FaultRow]:
    """The rows of all defended victims that faults were driven on, best mean first."""
    groups: dict[tuple[object, ...], list[Comparison]] = {}
    for one in comparisons:
        if one.identity["attack"] == FAULT:
            groups.setdefault((*one.ranked_as, one.identity["threat_norm"], one.identity["grid"]), []).append(one)
    return sorted(map(FaultRow.of, groups.values()), key=lambda row: -row.mean)


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
