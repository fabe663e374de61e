"""Scores under faults without an adversary (`attack=faults`): of each defended victim the mean, the worst and the crash rate.

They rank nothing: nobody chose them against a victim. They stand beside the worst case under attacks, as the corruptions of
RobustBench (Croce et al. 2021) stand beside its adversarial accuracy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cavbench.leaderboard.comparisons.comparison import Comparison

FAULT = "fault"


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


def is_fault(one: Comparison) -> bool:
    """Whether a comparison is about a fault, which nobody chose."""
    return bool(one.identity["attack"] == FAULT)


def fault_rows(comparisons: Sequence[Comparison]) -> list[FaultRow]:
    """The rows of all defended victims that faults were driven on, best mean first."""
    groups: dict[tuple[object, ...], list[Comparison]] = {}
    for one in filter(is_fault, comparisons):
        groups.setdefault((*one.ranked_as, one.identity["threat_norm"], one.identity["grid"]), []).append(one)
    return sorted(map(FaultRow.of, groups.values()), key=lambda row: -row.mean)


def under_faults(comparisons: Sequence[Comparison]) -> dict[tuple[object, ...], FaultRow]:
    """By what is ranked, its row under faults: on the grid with the most of them."""
    found: dict[tuple[object, ...], list[Comparison]] = {}
    for one in filter(is_fault, comparisons):
        found.setdefault(one.ranked_as, []).append(one)
    return {ranked: max(fault_rows(own), key=lambda row: row.faults) for ranked, own in found.items()}
