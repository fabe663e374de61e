"""The intervals that a leaderboard prints hold the truth as often as they say."""

from __future__ import annotations

import pytest
from scipy.stats import binom

from tests.leaderboard.simulated_studies import STUDIES, coverage

COUNT = 150
LEAST, MOST = binom.ppf(0.0005, COUNT, 0.94), binom.ppf(0.9995, COUNT, 0.97)
"""Hits that a coverage of 94 to 97 % leaves likely; with 39 %, or with intervals twice as wide, they are out of reach."""


@pytest.mark.parametrize("runs", [3, 10])
@pytest.mark.parametrize("title", ["dqn + advtrain, pgd", "ddpg, zo"])
def test_printed_intervals_hold_the_truth(title: str, runs: int) -> None:
    hits = coverage(STUDIES[title], runs, COUNT)
    assert len(hits) == 5
    for name, count in hits.items():
        assert LEAST <= count <= MOST, f"{name}: {count} of {COUNT}"
