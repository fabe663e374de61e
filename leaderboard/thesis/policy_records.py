"""Which of our records stand beside a number of chapter 4 of the thesis, and the command that makes the ones that are missing."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Literal

import pyarrow as pa
import pyarrow.compute as pc

from cavbench.core.track import track
from cavbench.driving.track import BEST_BLIND, DrivingTrack
from cavbench.leaderboard.comparisons.baselines import Baselines
from cavbench.leaderboard.comparisons.comparison import ATTACKER, DEFENDED, IDENTITY, parameters
from cavbench.leaderboard.comparisons.reading import SCENARIO, groups, newest
from cavbench.leaderboard.thesis.shipped import shipped as shipped_records
from cavbench.scenarios import Cell
from cavbench.statistics.episodes import Episodes
from cavbench.statistics.estimates import Interval, interval, share_interval

Victim = Literal["dqn", "ddpg"]
Attack = Literal["none", "zo", "noise"]

CLEAR = "clear"
TRAINED_ON = Cell(lanes=3, density=1.0, weather=CLEAR)
"""The road of tables 4.1 and 4.2."""
BUDGET = 0.2
"""Of every attack of chapter 4, L-inf on the [-1, 1] scale (4.4.3)."""
TARGETS: dict[str, dict[str, float]] = {
    "dqn": {"target_action": 3},
    "ddpg": {"target_acceleration": 1.0, "target_steering": 0.5},
}
"""What the thesis' attack drives a victim to (4.4.3): FASTER; full throttle and a turn to the right."""
COLUMNS = (*IDENTITY, *SCENARIO, "world_facts", "created_at", "return", "safe_progress")
"""Of a record that are read here."""


@dataclass(frozen=True)
class Wanted:
    """What stands beside one number of the thesis.

    Args:
        victim: the policy.
        attack: `none`, `zo` with the thesis' objective, or `noise` of the same budget.
        skip: of adversarial training; None is the undefended policy.
    """

    victim: Victim
    attack: Attack = "none"
    skip: float | None = None

    def matches(self, record: dict[str, object]) -> bool:
        """Whether a record's identity columns are those of the thesis' setting."""
        if record["victim"] != self.victim or record["attack"] != self.attack:
            return False
        if self.attack != "none" and (record["threat_norm"], record["threat_budget"]) != ("linf", BUDGET):
            return False
        attack = parameters(record["attack_params"])
        if self.attack == "zo":
            asked = {"objective": "target", **TARGETS[self.victim]}
            if any(attack.get(name, value) != value for name, value in asked.items()):
                return False
        if self.skip is None:
            return record["defense"] == "none"
        return record["defense"] == "advtrain" and parameters(record["defense_params"]).get("skip") == self.skip


@dataclass(frozen=True)
class Found:
    """The episodes that stand beside a number of the thesis.

    Args:
        episodes: of the newest matching pair with the most records.
        shipped: whether they are ours, published with the package, not the user's own.
    """

    episodes: Episodes
    shipped: bool

    @cached_property
    def episode_return(self) -> Interval:
        """Of at most 450."""
        return interval(self.episodes.column("return"))

    @cached_property
    def safe_progress(self) -> Interval:
        """In [0, 1]."""
        return share_interval(self.episodes.column("safe_progress"))


class Source:
    """The user's own records and, where they have none, the published ones.

    Args:
        records: the user's.
        shipped: the published ones; None reads those of the package.
    """

    def __init__(self, records: pa.Table, shipped: pa.Table | None = None) -> None:
        self.track = track(DrivingTrack.name)
        tables = (records, shipped_records("policies") if shipped is None else shipped)
        self.tables = [clear(table).select(COLUMNS) for table in tables]
        self.missing: list[tuple[Wanted, tuple[Cell, ...]]] = []
        self._driven = cache(self._groups)

    def find(self, wanted: Wanted, cells: Sequence[Cell] = (TRAINED_ON,)) -> Found | None:
        """The episodes in these cells; None, and noted as missing, where there are none."""
        for shipped in (False, True):
            candidates = [rows for identity, rows in self._driven(shipped, tuple(cells)) if wanted.matches(identity)]
            if candidates:
                most = max(candidates, key=lambda rows: rows.num_rows)
                return Found(Episodes.arrange(newest(most, (*DEFENDED, *ATTACKER))), shipped)
        self.missing.append((wanted, tuple(cells)))
        return None

    def _groups(self, shipped: bool, cells: tuple[Cell, ...]) -> list[tuple[dict[str, object], pa.Table]]:
        """What was driven in these cells, by attack and defended victim."""
        return list(groups(_in(self.tables[shipped], set(cells).__contains__), (*DEFENDED, *ATTACKER)))

    def baseline(self, found: Found | None, name: str = BEST_BLIND) -> Interval | None:
        """The return of a baseline on the scenarios of `found`."""
        if found is None:
            return None
        for drivers in self._baselines:
            if baseline := drivers.beside(found.episodes).get(name):
                return interval(baseline.only(runs=baseline.runs[:1]).column("return"))
        return None

    @cached_property
    def _baselines(self) -> list[Baselines]:
        """Of the user's records, and of the published ones."""
        made = []
        for table in self.tables:
            blind = table.filter(pc.and_(pc.invert(table["sees"]), pc.equal(table["attack"], "none")))
            drives = [Episodes.arrange(newest(rows, DEFENDED)) for _, rows in groups(blind, DEFENDED)]
            made.append(Baselines(self.track, drives))
        return made

    def commands(self) -> list[str]:
        """What to type for everything that was asked for and not found."""
        made: dict[tuple[Victim, tuple[Cell, ...]], list[Wanted]] = {}
        for wanted, cells in self.missing:
            made.setdefault((wanted.victim, cells), []).append(wanted)
        lines = []
        for (victim, cells), all_wanted in made.items():
            for skips in ({None}, {wanted.skip for wanted in all_wanted} - {None}):
                some = [wanted for wanted in all_wanted if wanted.skip in skips]
                if some:
                    lines.append(_command(victim, cells, some))
        return lines


def clear(table: pa.Table) -> pa.Table:
    """The records in clear weather, which chapter 4 is about."""
    return _in(table, lambda cell: cell.get("weather") == CLEAR)


def _in(table: pa.Table, wanted: Callable[[Cell], bool]) -> pa.Table:
    """The records in some cells."""
    texts = [text for text in pc.unique(table["cell"]).to_pylist() if wanted(Cell(**json.loads(text)))]
    return table.filter(pc.is_in(table["cell"].cast(pa.string()), pa.array(texts, pa.string())))


def _command(victim: Victim, cells: Sequence[Cell], wanted: Sequence[Wanted]) -> str:
    # A clean control is part of every run, so that a missing one comes with any attack.
    attacks = [name for name in ("zo", "noise") if any(each.attack == name for each in wanted)] or ["zo"]
    skips = sorted({each.skip for each in wanted if each.skip is not None})
    words = [f"victim={victim}", f"attack={','.join(attacks)}"]
    words += ["attack.objective=target"] if "zo" in attacks else []
    words += [f"threat.norm=linf threat.budget={BUDGET:g}", f"weather={CLEAR}"]
    if skips:
        words.append(f"defense=advtrain defense.skip={','.join(f'{skip:g}' for skip in skips)}")
    if len(cells) == 1:
        words.append(f"lanes={cells[0].lanes} density={cells[0].density:g}")
    return " ".join(["bench run", *words])
