"""How often the intervals that a leaderboard prints hold the truth, in simulated studies.

    python -m tests.leaderboard.simulated_studies 400  # studies/interval_coverage.md, with so many studies a line
    python -m tests.leaderboard.simulated_studies 200 unequal   # one of them: coverage, bad or unequal

A study is a set of records: two defended victims under two attacks each, on the clear roads of the standard grid. Each episode
crashes with a probability that is the sum of a cell, a training, a scenario and their interaction, cut at 0 and 1; one that does
not crash scores 0.9. The records go through `read_boards`, and what its rows print is compared with the truth.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from statistics import NormalDist
from typing import Any

import numpy as np
import pyarrow as pa
from rich.console import Console

from cavbench.leaderboard.ranking.boards import Row, read_boards
from cavbench.leaderboard.ranking.worst import margin
from cavbench.statistics.estimates import Interval
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
        bad: the share of trainings that crash more often, and by how much; `training` comes on top.
        learns: whether the first victim does; otherwise it has no training effect.
    """

    training: float
    scenario: float
    both: float
    crashes: tuple[float, float]
    bad: tuple[float, float] = (0.0, 0.0)
    learns: bool = True


STUDIES = {
    "dqn + advtrain, pgd": Study(0.04, 0.085, 0.09, (0.66, 0.50)),
    "dqn + advtrain, clean": Study(0.04, 0.06, 0.06, (0.10, 0.25)),
    "ddpg, zo": Study(0.13, 0.03, 0.12, (0.70, 0.50)),
    "ddpg + advtrain, zo": Study(0.27, 0.05, 0.11, (0.40, 0.50)),
    "no training effect": Study(0.0, 0.06, 0.06, (0.30, 0.40)),
}
"""The components of pairs in the published records (`safe_progress` and crashes have much the same), and one without a training
effect."""
BAD = {
    "crashes near 0, trainings differ by .15": Study(0.15, 0.05, 0.05, (-0.1, 0.3)),
    "crashes near 0, trainings differ by .1": Study(0.1, 0.05, 0.05, (0.0, 0.3)),
    "1 of 10 trainings crashes in 30 % more": Study(0.0, 0.02, 0.02, (0.0, 0.3), (0.1, 0.3)),
    "1 of 5 trainings crashes in 30 % more": Study(0.0, 0.02, 0.02, (0.0, 0.3), (0.2, 0.3)),
    "1 of 5 trainings crashes in 10 % more": Study(0.0, 0.02, 0.02, (0.0, 0.3), (0.2, 0.1)),
    "crashes near 1, trainings differ by .15": Study(0.15, 0.05, 0.05, (1.1, 0.3)),
}
"""A few trainings, most of them good: the means are of the normal distribution that is cut at 0."""
EQUAL = {
    "dqn + advtrain, pgd": Study(0.04, 0.085, 0.09, (0.58, 0.58)),
    "ddpg, zo": Study(0.13, 0.03, 0.12, (0.60, 0.60)),
    "ddpg + advtrain, zo": Study(0.27, 0.05, 0.11, (0.45, 0.45)),
    "crashes near 0": Study(0.15, 0.05, 0.05, (-0.1, -0.1)),
    "1 of 5 trainings crashes in 30 % more": Study(0.0, 0.02, 0.02, (0.05, 0.05), (0.2, 0.3)),
}
"""Two victims that are equal in truth."""
DESIGNS = {"1 and 10": (1, 10), "1 and 4": (1, 4), "3 and 10": (3, 10), "1 and 1": (1, 1), "rules and 10": (0, 10)}
"""Trainings of the first and of the second victim; 0 for a driver that does not learn."""
CELL_EFFECTS = np.linspace(-0.1, 0.1, len(CLEAR))
"""The second attack is the strongest in every other cell."""
WEAKER = 0.15


BLIND = 0.8
"""The mean crash probability of the baseline that ignores its input."""


@cache
def _records(runs: tuple[int, int]) -> tuple[pa.Table, list[tuple[int, int]]]:
    """The records of a study without its outcomes, and of each part the victim (2: blind) and the attack (0: none)."""
    common: Any = {"cells": CLEAR, "episodes": SCENARIOS}
    parts, kinds = [], []
    for victim, (defense, count) in enumerate(zip(("none", "advtrain"), runs, strict=True)):
        for attack, name in enumerate(("none", "zo", "pgd")):
            queries = 40.0 * bool(attack)
            part = drive(attack=name, defense=defense, runs=range(max(count, 1)), queries=queries, **common)
            if count:
                # Each training has a network of its own: equal ones would be compared, drive by drive, in every study.
                place = part.schema.get_field_index("weights_sha256")
                weights = [f"{victim + 1} {seed}" for seed in part["training_seed"].to_pylist()]
                part = part.set_column(
                    place, part.schema.field(place), pa.array(weights, part.schema.field(place).type)
                )
            parts.append(part)
            kinds.append((victim, attack))
    parts.append(drive("blind", victim_params={"policy": "slower"}, sees=False, runs=(0,), **common))
    return pa.concat_tables(parts), [*kinds, (2, 0)]


def _means(study: Study, victim: int, attack: int) -> np.ndarray:
    """[C] the crash probability before it is cut; of the two attacks each is the strongest in every other cell."""
    if victim == 2:
        return BLIND + CELL_EFFECTS
    weaker = np.arange(len(CLEAR)) % 2 == attack % 2 if attack else np.ones(len(CLEAR), bool)
    return study.crashes[victim] + CELL_EFFECTS - WEAKER * weaker


def _outcomes(
    study: Study, runs: tuple[int, int], kinds: list[tuple[int, int]], generator: np.random.Generator
) -> np.ndarray:
    """Whether each episode crashes, in the order of the records."""
    scenario = study.scenario * generator.standard_normal((1, 1, SCENARIOS))
    share, more = study.bad
    trained = [
        bool(count) * study.training * generator.standard_normal((max(count, 1), 1, 1))
        + study.both * generator.standard_normal((max(count, 1), 1, SCENARIOS))
        + bool(count) * more * (generator.random((max(count, 1), 1, 1)) < share)
        for count in runs
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

    share, more = study.bad if trains else (0.0, 0.0)
    return float(np.mean([(1 - share) * cut(mean) + share * cut(mean + more) for mean in means]))


def _rows(study: Study, runs: tuple[int, int], generator: np.random.Generator) -> list[Row]:
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
    first, second = (row.worst for row in _rows(study, (runs, runs), generator))
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


def called_different(study: Study, design: tuple[int, int], studies: int, seed: int = 0) -> int:
    """In how many simulated studies of equal victims their rows have different ranks."""
    generator = np.random.default_rng(seed)
    # A driver that does not learn is as good as the trainings of the other are in the mean.
    rules = expected(study, study.crashes[0] + CELL_EFFECTS)
    if not design[0]:
        spread = replace(study, training=0.0, bad=(0.0, 0.0))
        means = np.linspace(-0.5, 1.5, 401)
        closest = min(means, key=lambda mean: abs(expected(spread, mean + CELL_EFFECTS) - rules))
        study = replace(study, crashes=(float(closest), study.crashes[1]))
    return sum(len({row.group for row in _rows(study, design, generator)}) > 1 for _ in range(studies))


NAMES = ("score", "crash rate", "difference of rows", "against blind", "effect of an attack")


def tables(count: int, only: str = "") -> Iterator[str]:
    """The tables in studies/interval_coverage.md."""
    if only in ("", "coverage"):
        yield f"| variance of | seeds | {' | '.join(NAMES)} |\n|---|---|{'---|' * len(NAMES)}"
        for title, study in STUDIES.items():
            for runs in (3, 5, 10):
                hits = coverage(study, runs, count)
                yield f"| {title} | {runs} | {' | '.join(f'{100 * hits[name] / count:.1f} %' for name in NAMES)} |"
    if only in ("", "bad"):
        yield "| crash rates | 3 seeds | 4 seeds | 10 seeds |\n|---|---|---|---|"
        for title, study in BAD.items():
            hits = [coverage(study, runs, count)["crash rate"] for runs in (3, 4, 10)]
            yield f"| {title} | {' | '.join(f'{100 * one / count:.1f} %' for one in hits)} |"
    if only in ("", "unequal"):
        yield f"| equal victims | {' | '.join(DESIGNS)} |\n|---|{'---|' * len(DESIGNS)}"
        for title, study in EQUAL.items():
            wrong = [called_different(study, design, count) for design in DESIGNS.values()]
            yield f"| {title} | {' | '.join(f'{100 * one / count:.1f} %' for one in wrong)} |"


if __name__ == "__main__":
    say = Console(width=200, highlight=False).print
    for line in tables(int(sys.argv[1]) if len(sys.argv) > 1 else 200, *sys.argv[2:3]):
        say(line)
