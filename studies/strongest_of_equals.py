"""The luck of the strongest of ten attacks that are equal in truth: how far below the truth it looks, and what cavbench prints.

    python -m studies.strongest_of_equals [--studies 200] [--only choices|races|variants]

Episodes crash with the variance components of `dqn` + `advtrain` under `pgd` in the published records. Attacks share
scenarios and trainings; each has its own coins. The choice, its interval and the race of `until=` are the product's.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from cavbench.run.plan import SCENARIOS
from cavbench.run.rounds import Row, look
from cavbench.statistics.estimates import Array, share_interval
from cavbench.statistics.strongest import strongest_of, under
from tests.leaderboard.simulated_studies import PROGRESS, STUDIES, Study, expected

ATTACKS, CELLS, MOST = 10, 18, 100
COMPONENTS = STUDIES["dqn + advtrain, pgd"]
CELL_EFFECTS = np.linspace(-0.1, 0.1, CELLS)


@dataclass(frozen=True)
class Drawn:
    """Scores [A, R, C, E], the mean under the strongest attack of each cell in truth, and that under each attack [A]."""

    scores: Array
    truth: float
    each: Array


def drawn(
    rng: np.random.Generator,
    runs: int,
    episodes: int,
    *,
    cells: int = CELLS,
    attacks: int = ATTACKS,
    apart: float = 0.0,
    weak: float = 0.0,
) -> Drawn:
    """One study. With one run the truth is that of its policy, else that of all trainings.

    Args:
        apart: by how much each attack is weaker in the cells where another one is the strongest, in crashes an episode.
        weak: by how much the second half of the attacks is weaker in every cell.
    """
    training = COMPONENTS.training * rng.standard_normal((runs, 1, 1))
    scenario = COMPONENTS.scenario * rng.standard_normal((1, 1, episodes))
    both = COMPONENTS.both * rng.standard_normal((runs, 1, episodes))
    effects = CELL_EFFECTS[np.linspace(0, CELLS - 1, cells).astype(int)] if cells > 1 else np.zeros(1)
    means = COMPONENTS.crashes[0] + effects
    number = np.arange(attacks)[:, None]
    weaker = apart * (number != np.arange(cells) % attacks) + weak * (number >= attacks // 2)
    chance = (means - weaker)[:, None, :, None] + training + scenario + both
    study: Study = COMPONENTS
    if runs == 1:
        study, means = replace(COMPONENTS, training=0.0), means + float(training[0, 0, 0])
    truth, each = expected(study, (means - weaker).max(0)), [expected(study, means - one) for one in weaker]
    return Drawn(
        PROGRESS * (rng.random(chance.shape) >= chance), PROGRESS * (1 - truth), PROGRESS * (1 - np.array(each))
    )


def chosen(study: Drawn) -> tuple[float, float, bool]:
    """How far from the truth the least means of the cells are, and what is printed; and whether its interval holds the truth."""
    least = study.scores.mean((1, 3)).min(0).mean()
    printed = share_interval(under(strongest_of(study.scores), study.scores))
    return least - study.truth, printed.estimate - study.truth, study.truth in printed


def raced(study: Drawn, until: float) -> tuple[float, ...]:
    """The same after the race of `until=`, among the attacks that drive to the end; whether the sequence of the lowest of these
    holds its truth; how many they are, and how many scenarios they drive."""
    rows = [Row(cast(Any, SimpleNamespace(id=str(number))), until, MOST) for number in range(len(study.scores))]
    for first in range(0, MOST, SCENARIOS):
        for row, scores in zip(rows, study.scores, strict=True):
            if row.stop is None:
                row.parts.append(scores[:, :, first : first + SCENARIOS])
        look(rows)
    driven = max(len(row.parts) for row in rows)
    last = [row for row in rows if len(row.parts) == driven]
    least, printed, holds = chosen(replace(study, scores=np.stack([row.scores for row in last])))
    stops = [row.stop or row.stopped("grid done") for row in rows]
    number = int(np.argmin([stop.estimate if rows[n] in last else 1 for n, stop in enumerate(stops)]))
    return least, printed, holds, stops[number].low <= study.each[number] <= stops[number].high, len(last), 10 * driven


def of_choices(count: int) -> Iterator[str]:
    """The table of what is chosen and printed."""
    yield "| attacks | runs x scenarios | least mean | printed | interval holds |\n|---|---|---|---|---|"
    for apart in (0.0, 0.02):
        for runs, episodes in ((10, 64), (1, 64), (1, 10)):
            rng = np.random.default_rng(0)
            found = np.array([chosen(drawn(rng, runs, episodes, apart=apart)) for _ in range(count)]).mean(0)
            name = f"{apart:g} apart" if apart else "equal"
            yield f"| {name} | {runs} x {episodes} | {found[0]:+.3f} | {found[1]:+.3f} | {found[2]:.1%} |"


def of_races(count: int) -> Iterator[str]:
    """The table of races with `until=`."""
    names = ("least mean", "printed", "interval holds", "sequence of the lowest holds", "to the end", "scenarios")
    yield f"| race | until | {' | '.join(names)} |\n|---|---|{'---|' * len(names)}"
    for until, apart, weak in ((0.05, 0.0, 0.0), (0.05, 0.02, 0.0), (0.05, 0.0, 0.3), (0.02, 0.0, 0.3)):
        rng = np.random.default_rng(0)
        found = np.array([raced(drawn(rng, 1, MOST, apart=apart, weak=weak), until) for _ in range(count)]).mean(0)
        name = " and ".join([f"{apart:g} apart"] * (apart > 0) + [f"half weaker by {weak:g}"] * (weak > 0)) or "equal"
        shown = [f"{found[0]:+.3f}", f"{found[1]:+.3f}", f"{found[2]:.1%}", f"{found[3]:.1%}", f"{found[4]:.1f}"]
        yield f"| {name} | {until:g} | {' | '.join([*shown, f'{found[5]:.0f}'])} |"


def of_variants(count: int) -> Iterator[str]:
    """The table of the best of eight equal variants of an attack, of one training on 64 scenarios."""
    yield "| cells | one of the eight looks 0.035 stronger | the best of them looks stronger by |\n|---|---|---|"
    for cells in (1, 3, CELLS):
        rng = np.random.default_rng(0)
        means = [drawn(rng, 1, 64, cells=cells, attacks=9).scores.mean((1, 2, 3)) for _ in range(10 * count)]
        best = np.array([mean[0] - mean[1:].min() for mean in means])
        yield f"| {cells} | {np.mean(best >= 0.035):.1%} | {best.mean():.3f} |"


TABLES = {"choices": of_choices, "races": of_races, "variants": of_variants}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--studies", type=int, default=200)
    parser.add_argument("--only", choices=TABLES)
    given = parser.parse_args()
    for name in [given.only] if given.only else TABLES:
        for line in TABLES[name](given.studies):
            print(line, flush=True)


if __name__ == "__main__":
    main()
