"""Scores under faults without an adversary (`attack=faults`): of each defended victim the mean, the worst and the crash rate.

They rank nothing: nobody chose them against a victim. They stand beside the worst case under attacks, as the corruptions of
RobustBench (Croce et al. 2021) stand beside its adversarial accuracy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from cavbench.core import sets, suites
from cavbench.core.outline import outline
from cavbench.core.parameters import parameters as declared
from cavbench.core.registry import Kind
from cavbench.core.suites import Suite
from cavbench.leaderboard.comparisons.comparison import Comparison, parameters

FAULT = "fault"


@dataclass(frozen=True)
class FaultRow:
    """A defended victim under faults: scores, crash rates in [0, 1], and the worst fault's parameters.

    Args:
        name: defence and victim.
        faults: number of faults.
        suite: the newest version of the suite of which it has every fault, such as `faults-2`; empty if there is none.
        runs, cells, scenarios: of each fault: training seeds, cells, and scenarios a cell.
        clean, mean, worst: scores without a fault, over all faults, and under the worst.
        crashed, worst_crashed: crash rate over all faults, and under the worst of them.
        idm: score of IDM on the same scenarios; NaN where it was not driven.
        hardest: what the worst fault is.
    """

    name: str
    faults: int
    suite: str
    runs: int
    cells: int
    scenarios: int
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
            suite=_suite(found),
            runs=len(first.own.runs),
            cells=len(first.cells),
            scenarios=len(first.own.seeds),
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
        groups.setdefault((*one.ranked_as, _beside_traffic(one), one.identity["grid"]), []).append(one)
    return sorted(map(FaultRow.of, groups.values()), key=lambda row: -row.mean)


def _beside_traffic(one: Comparison) -> tuple[str, ...]:
    """The sets of its threat model but for `dynamics`, in which the faults of other drivers differ from all others."""
    norm, words = sets.split(str(one.identity["threat_norm"]))
    return (norm, *(word for word in words if not word.startswith("dynamics.")))


def _suite(found: Sequence[Comparison]) -> str:
    """The newest suite of faults whose members are all among these."""
    present = {(one.settings["attack.mode"], one.settings["attack.severity"]) for one in found}

    def whole(suite: Suite) -> bool:
        return all((member.params["mode"], member.params["severity"]) in present for member in suite.members)

    return next((suite.name for suite in reversed(versions()) if whole(suite)), "")


@cache
def versions() -> tuple[Suite, ...]:
    """The versions of the suite `faults`, the oldest first."""
    return tuple(suites.versions("faults"))


Faults = Sequence[tuple[Comparison, FaultRow]]
"""The rows under faults, each with one of its comparisons, which says what is defended."""


def under_faults(comparisons: Sequence[Comparison]) -> Faults:
    """Of what is ranked, its row under faults: on the grid with the most of them.

    A row without every fault of a version of the suite is unfinished, and left out if another has more faults.
    """
    found: dict[tuple[object, ...], list[Comparison]] = {}
    for one in filter(is_fault, comparisons):
        found.setdefault(one.ranked_as, []).append(one)
    rows = [(own[0], max(fault_rows(own), key=lambda row: row.faults)) for own in found.values()]
    most = max((row.faults for _, row in rows), default=0)
    return [(one, row) for one, row in rows if row.suite or row.faults == most]


def of(one: Comparison, faults: Faults) -> FaultRow | None:
    """The row under faults of what a comparison defends; None if they were not driven."""
    return next((row for other, row in faults if one.mine == other.mine and _alike(one, other)), None)


def _alike(one: Comparison, other: Comparison) -> bool:
    """Whether two comparisons defend the same. A parameter that records lack, because it is newer, has its default."""
    for kind in ("defense", "victim", "world"):
        if one.identity[kind] != other.identity[kind]:
            return False
        own, others = (parameters(each.identity[f"{kind}_params"]) for each in (one, other))
        if any(own[name] != others[name] for name in own.keys() & others.keys()):
            return False
        added = {**own, **others}
        lone = own.keys() ^ others.keys()
        if lone and any(_defaults(kind, str(one.identity[kind])).get(name, ...) != added[name] for name in lone):
            return False
    return True


@cache
def _defaults(kind: Kind, name: str) -> dict[str, object]:
    """The defaults of a built-in component; nothing is imported to know them."""
    found = outline(kind, name)
    return {} if found is None else {key: one.default for key, one in declared(found).items()}
