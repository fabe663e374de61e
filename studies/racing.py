"""What a race costs and how well it finds the score: replayed on the published records, and simulated.

    python studies/racing.py

Of each published row with ten trainings or thirty scenarios, forty pilots are drawn. The score of the attacks that go on is
compared with that of all, and with the bound that the report adds to the interval. The simulation has twelve attacks, each better
than the others in some cells, and compares with the truth.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from cavbench.statistics.racing import PILOT_RUNS, PILOT_SCENARIOS, hidden, kept
from cavbench.statistics.strongest import strongest_of, under

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.statistics.test_racing import drawn

DATA = Path(__file__).parents[1] / "leaderboard" / "data" / "standard-v2"
ROWS = {"dqn": (10, 10), "dqn+advtrain": (10, 10), "planner": (1, 30), "planner+tracker": (1, 30)}
"""Trainings and scenarios of the published rows that have enough of one of them."""
PILOTS = 40


def scores_of(row: str, runs: int, scenarios: int) -> np.ndarray:
    """[A, R, C, E] of the attacks of a published row that have all of these."""
    names = ("attack", "attack_params", "training_seed", "seed", "cell", "safe_progress")
    table = pq.read_table(DATA / f"{row}.parquet", columns=list(names)).to_pandas()
    table = table[table.attack != "none"]
    table = table[table.seed.isin(sorted(table.seed.unique())[:scenarios])]
    found = []
    for _, own in table.groupby(table.attack.astype(str) + table.attack_params.astype(str)):
        wide = own.pivot_table(index="training_seed", columns=["cell", "seed"], values="safe_progress")
        if len(wide) >= runs and not wide.isna().any().any() and wide.shape[1] % scenarios == 0:
            found.append(wide.to_numpy()[:runs].reshape(runs, -1, scenarios))
    return np.stack(found)


def robust(scores: np.ndarray) -> float:
    """The score under the strongest attack of each cell."""
    return float(under(strongest_of(scores), scores).mean())


def said(name: str, found: Sequence[tuple[float, float]], cost: float | None = None) -> None:
    """Print a row of the table: the mean and largest error, the mean bound, and how often it holds."""
    errors, bounds = np.asarray(found).T
    holds = np.mean(errors <= bounds + 1e-9)
    price = "" if cost is None else f"{cost:.2f}"
    print(
        f"| {name} | {price} | {errors.mean():+.4f} | {errors.max():+.4f} | {bounds.mean():.4f} | {holds:.3f} |",
        flush=True,
    )


def replayed(row: str, rng: np.random.Generator) -> None:
    """Race a published row with pilots drawn from it."""
    scores = scores_of(row, *ROWS[row])
    attacks, runs, cells, scenarios = scores.shape
    own, seeds = min(PILOT_RUNS, runs), min(PILOT_SCENARIOS, scenarios)
    found, every, on = [], robust(scores), []
    for _ in range(PILOTS):
        places = np.ix_(range(attacks), rng.choice(runs, own, False), range(cells), rng.choice(scenarios, seeds, False))
        pilot = scores[places]
        on.append(kept(pilot))
        found.append((robust(scores[on[-1]]) - every, hidden(pilot)))
    share = own * seeds / runs / scenarios
    said(row, found, share + np.mean([len(one) for one in on]) / attacks * (1 - share))


def simulated(runs: int, rng: np.random.Generator, races: int = 400) -> None:
    """Race attacks of about the same strength, and compare with 200 scenarios of all."""
    found = []
    for _ in range(races):
        every = drawn(rng, 12, runs, 200)
        pilot = every[..., :PILOT_SCENARIOS]
        found.append((robust(every[kept(pilot)]) - robust(every), hidden(pilot)))
    said(f"simulated, {runs} training{'s' * (runs > 1)}", found)


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(0)
    print("| row | cost | mean error | largest error | mean bound | holds |\n|---|---|---|---|---|---|")
    for row in ROWS:
        replayed(row, rng)
    for runs in (1, 5):
        simulated(runs, rng)


if __name__ == "__main__":
    main()
