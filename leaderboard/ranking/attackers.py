"""The ranking of attacks: what each adds to all others, what it costs, and what it asks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow.compute as pc

from cavbench.leaderboard.comparisons.comparison import Comparison
from cavbench.leaderboard.comparisons.reading import MAKING
from cavbench.leaderboard.ranking.boards import Board, Row
from cavbench.leaderboard.ranking.worst import margin

DIGITS = 2
"""Behind the point of what attacks are told apart by."""


@dataclass(frozen=True, eq=False)
class Attacker:
    """An attack on the defended victims of a leaderboard, with all its variants: the sets of parameters that it was run with.

    Args:
        name: of the attack.
        attacks: its pairs, in the order of the rows.
        rows: number of defended victims that it was driven on.
        variants: number of sets of parameters.
        added: by how much it lowers the score below that under all other attacks; mean over the rows. On a row without other
            attacks that is the fall from the clean score; NaN where that is not known either.
        alone: clean score minus the score under its strongest variant of each cell, mean over the rows; NaN where no clean
            score is known.
        strongest: share of the cells of these rows in which it is the strongest.
        queries: of all its variants on a row, in the unit of the track; mean over the rows.
        seconds: of work for an episode under each of its variants: of one process, with the driving itself and what was crafted
            beforehand; mean over the rows.
        group: rank, from 1; attacks that add the same, to two digits, share it.
    """

    name: str
    attacks: tuple[Comparison, ...]
    rows: int
    variants: int
    added: float
    alone: float
    strongest: float
    queries: float
    seconds: float
    group: int = 0


def attackers(board: Board) -> list[Attacker]:
    """The attacks that count on a leaderboard, the one that adds most first; of equals the one that lowers the score more."""
    names = {str(attack.identity["attack"]) for row in board.rows for attack in row.attacks}
    found = sorted((_attacker(name, board.rows) for name in sorted(names)), key=_order)
    steps = sorted({_step(one) for one in found}, reverse=True)
    return [replace(one, group=1 + steps.index(_step(one))) for one in found]


def _step(one: Attacker) -> float:
    """What it adds, as far as attacks are told apart; one of which that is not known comes last."""
    return -math.inf if math.isnan(one.added) else round(one.added, DIGITS)


def _order(one: Attacker) -> tuple[object, ...]:
    return -_step(one), -round(float(np.nan_to_num(one.alone)), 9), one.name


def _attacker(name: str, rows: Sequence[Row]) -> Attacker:
    own = [(row, [attack for attack in row.attacks if attack.identity["attack"] == name]) for row in rows]
    own = [(row, family) for row, family in own if family]
    counts = [one.identity["attack"] == name for row, _ in own for one in row.worst.attacks]
    return Attacker(
        name=name,
        attacks=tuple(attack for _, family in own for attack in family),
        rows=len(own),
        variants=len({attack.identity["attack_params"] for _, family in own for attack in family}),
        added=_mean([_added(row, family) for row, family in own]),
        alone=_mean([_alone(row, family) for row, family in own]),
        strongest=float(np.mean(counts)),
        queries=_mean([sum(attack.queries for attack in family) for _, family in own]),
        seconds=_mean([sum(map(seconds, family)) for _, family in own]),
    )


def _added(row: Row, family: Sequence[Comparison]) -> float:
    """Never negative: an attack that is nowhere the strongest adds nothing, and below that is what the choice missed."""
    whole = row.worst.panel.whole
    every = row.worst if whole is row.worst.panel else whole.strongest()
    rest = whole.strongest([one for one in row.attacks if one not in family])
    change = margin(rest, every) if rest and every else None
    found = _alone(row, family) if change is None else change.estimate
    return found if math.isnan(found) else max(found, 0.0)


def _alone(row: Row, family: Sequence[Comparison]) -> float:
    found = row.worst.panel.whole.strongest(family)
    return found.clean.estimate - found.score.estimate if found and found.clean else math.nan


def seconds(one: Comparison) -> float:
    """Seconds of work for an episode: a unit and an artefact are counted once, not once an episode."""
    table = one.own.table
    units = table.group_by("unit").aggregate([("wall_s", "max")])
    total = pc.sum(units["wall_s_max"]).as_py() or 0.0
    if one.track.artefact and MAKING in table.column_names:
        made = table.group_by(f"{one.track.artefact[0]}_sha256").aggregate([(MAKING, "max")])
        total += pc.sum(made[f"{MAKING}_max"]).as_py() or 0.0
    return float(total) / table.num_rows


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else math.nan
