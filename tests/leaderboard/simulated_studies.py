"""How often the intervals that a leaderboard prints hold the truth, in simulated studies.

    python -m tests.leaderboard.simulated_studies 2000       # the table in docs/metrics.md, with so many studies a line

A study is a set of records: two defended victims under two attacks each, on the clear roads of the standard grid. Each episode
crashes with a probability that is the sum of a cell, a training, a scenario and their interaction, cut at 0 and 1; one that does
not crash scores 0.9. The records go through `read_boards`, and what its rows print is compared with the truth.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from statistics import NormalDist
from typing import Any

import numpy as np
import pyarrow as pa
from rich.console import Console

from bench.statistics.estimates import Interval
from leaderboard.ranking.boards import Row, read_boards
from leaderboard.ranking.worst import margin
from tests.leaderboard.synthetic import CLEAR, drive

SCENARIOS = 20
PROGRESS = 0.9


@dataclass(frozen=True)
class Study:
    """The variance components of crashes, as standard deviations, and the mean crash probability of each victim.

    Args:
        training: between training seeds, the same in all cells.
        scenario: between scenarios, the same for all victims.
        both: of a training seed on a scenario.
        crashes: mean of the first and of the second victim under its strongest attacks.
    """

    training: float
    scenario: float
    both: float
    crashes: tuple[float, float]


STUDIES = {
    "dqn + advtrain, pgd": Study(0.04, 0.085, 0.09, (0.66, 0.50)),
    "dqn + advtrain, clean": Study(0.04, 0.06, 0.06, (0.10, 0.25)),
    "ddpg, zo": Study(0.13, 0.03, 0.12, (0.70, 0.50)),
    "ddpg + advtrain, zo": Study(0.27, 0.05, 0.11, (0.40, 0.50)),
    "no training effect": Study(0.0, 0.06, 0.06, (0.30, 0.40)),
}
"""The components of pairs in the published records (`safe_progress` and crashes have much the same), and one without a training
effect."""
CELL_EFFECTS = np.linspace(-0.1, 0.1, len(CLEAR))
"""The second attack is the strongest in every other cell."""
WEAKER = 0.15


BLIND = 0.8
"""The mean crash probability of the baseline that ignores its input."""


@cache
def _records(runs: int) -> tuple[pa.Table, list[tuple[int, int]]]:
    """The records of a study without its outcomes, and of each part the victim (2: blind) and the attack (0: none)."""
    common: Any = {"cells": CLEAR, "episodes": SCENARIOS}
    parts, kinds = [], []
    for victim, defense in enumerate(("none", "advtrain")):
        for attack, name in enumerate(("none", "zo", "pgd")):
            queries = 40.0 * bool(attack)
            parts.append(drive(attack=name, defense=defense, runs=range(runs), queries=queries, weights="w", **common))
            kinds.append((victim, attack))
    parts.append(drive("blind", victim_params={"policy": "slower"}, sees=False, runs=(0,), **common))
    return pa.concat_tables(parts), [*kinds, (2, 0)]


def _means(study: Study, victim: int, attack: int) -> np.ndarray:
    """[C] the crash probability before it is cut; of the two attacks each is the strongest in every other cell."""
    if victim == 2:
        return BLIND + CELL_EFFECTS
    weaker = np.arange(len(CLEAR)) % 2 == attack % 2 if attack else np.ones(len(CLEAR), bool)
    return study.crashes[victim] + CELL_EFFECTS - WEAKER * weaker


def _outcomes(study: Study, runs: int, kinds: list[tuple[int, int]], generator: np.random.Generator) -> np.ndarray:
    """Whether each episode crashes, in the order of the records."""
    scenario = study.scenario * generator.standard_normal((1, 1, SCENARIOS))
    trained = [
        study.training * generator.standard_normal((runs, 1, 1))
        + study.both * generator.standard_normal((runs, 1, SCENARIOS))
        for _ in range(2)
    ]
    alone = study.both * generator.standard_normal((1, 1, SCENARIOS))
    crashed = []
    for victim, attack in kinds:
        chance = _means(study, victim, attack)[None, :, None] + scenario + [*trained, alone][victim]
        crashed.append((generator.random(chance.shape) < chance).ravel())
    return np.concatenate(crashed)


def expected(study: Study, means: np.ndarray, *, trains: bool = True) -> float:
    """The mean over cells, trainings and scenarios of a crash probability cut at 0 and 1."""
    spread = float(np.sqrt(trains * study.training**2 + study.scenario**2 + study.both**2))
    normal = NormalDist()

    def cut(mean: float) -> float:
        low, high = -mean / spread, (1 - mean) / spread
        inside = normal.cdf(high) - normal.cdf(low)
        return mean * inside + spread * (normal.pdf(low) - normal.pdf(high)) + 1 - normal.cdf(high)

    return float(np.mean([cut(mean) for mean in means]))


def _rows(study: Study, runs: int, generator: np.random.Generator) -> list[Row]:
    """The rows of one simulated study, the undefended victim first."""
    records, kinds = _records(runs)
    crashed = _outcomes(study, runs, kinds, generator)
    for name, values in {"crashed": crashed, "safe_progress": PROGRESS * ~crashed}.items():
        place = records.schema.get_field_index(name)
        field = records.schema.field(name)
        records = records.set_column(place, field, pa.array(values, field.type))
    (board,), _ = read_boards({"driving": records})
    return sorted(board.rows, key=lambda row: str(row.identity["defense"]), reverse=True)


def printed(study: Study, runs: int, generator: np.random.Generator) -> Iterator[tuple[str, Interval | None, float]]:
    """Every kind of interval of one simulated study, with what it should hold."""
    first, second = (row.worst for row in _rows(study, runs, generator))
    rates = [expected(study, study.crashes[victim] + CELL_EFFECTS) for victim in range(2)]
    blind = expected(study, _means(study, 2, 0), trains=False)
    yield "score", first.score, PROGRESS * (1 - rates[0])
    yield "crash rate", first.failure, rates[0]
    yield "difference of rows", margin(first, second), PROGRESS * (rates[1] - rates[0])
    yield "against blind", first.lead, PROGRESS * (blind - rates[0])
    pair = next(one for one in first.panel.attacks if one.identity["attack"] == "pgd")
    clean, attacked = (expected(study, _means(study, 0, attack)) for attack in (0, 2))
    yield "effect of an attack", pair.effect, PROGRESS * (clean - attacked)


def coverage(study: Study, runs: int, studies: int, seed: int = 0) -> Counter[str]:
    """In how many simulated studies the interval holds the truth, by what it is an interval of."""
    generator = np.random.default_rng(seed)
    found = (each for _ in range(studies) for each in printed(study, runs, generator))
    return Counter(name for name, interval, value in found if interval and value in interval)


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    names = ("score", "crash rate", "difference of rows", "against blind", "effect of an attack")
    say = Console(width=200, highlight=False).print
    say(f"| variance of | seeds | {' | '.join(names)} |\n|---|---|{'---|' * len(names)}")
    for title, study in STUDIES.items():
        for runs in (3, 5, 10):
            hits = coverage(study, runs, count)
            say(
                f"| {title} | {runs} | {' | '.join(f'{100 * hits[name] / count:.1f} %' for name in names)} |",
            )
