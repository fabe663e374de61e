"""The intervals that a leaderboard prints hold the truth as often as they say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from cavbench.statistics.independent import independent
from tests.leaderboard import simulated_patches
from tests.leaderboard.simulated_studies import BAD, DESIGNS, EQUAL, STUDIES, called_different, coverage

COUNT, FEWER = 150, 50
LEAST, MOST = binom.ppf(0.0005, COUNT, 0.94), COUNT - 1
"""Hits that a coverage of 94 to 97 % leaves likely. With 39 % there are fewer. Intervals twice as wide always hit (99.99 %)."""


@pytest.mark.parametrize("runs", [3, 10])
@pytest.mark.parametrize("title", ["dqn + advtrain, pgd", "ddpg, zo"])
def test_printed_intervals_hold_the_truth(title: str, runs: int) -> None:
    hits = coverage(STUDIES[title], runs, COUNT)
    assert len(hits) == 5
    for name, count in hits.items():
        assert LEAST <= count <= MOST, f"{name}: {count} of {COUNT}"


@pytest.mark.parametrize(
    ("title", "design"), [("hardened", "5 x 3"), ("hardened", "5 x 10"), ("places differ most", "5 x 10")]
)
def test_printed_intervals_of_detectors_hold_the_truth_for_other_patches_and_places(title: str, design: str) -> None:
    hits = simulated_patches.coverage(simulated_patches.STUDIES[title], simulated_patches.DESIGNS[design], FEWER)
    for name in simulated_patches.NAMES:
        assert hits[name] >= binom.ppf(0.0005, FEWER, 0.94), f"{name}: {hits[name]} of {FEWER}"


def test_an_interval_of_many_places_is_not_wider_than_the_spread_of_the_scores() -> None:
    """With an interval from 0 to 1 the truth is always inside."""
    study, generator = simulated_patches.STUDIES["hardened"], np.random.default_rng(0)
    wide = [simulated_patches.row(study, (5, 10), generator).worst.score for _ in range(5)]
    assert all(one.high - one.low < 4 * (study.patch + study.place) for one in wide)


@pytest.mark.parametrize("design", ["1 and 10", "1 and 4", "3 and 10", "1 and 1", "rules and 10"])
@pytest.mark.parametrize("title", ["ddpg, zo"])
def test_equal_victims_of_unequal_trainings_seldom_have_different_ranks(title: str, design: str) -> None:
    assert called_different(EQUAL[title], DESIGNS[design], FEWER) <= binom.ppf(0.9995, FEWER, 0.06)


@pytest.mark.parametrize("runs", [3, 10])
@pytest.mark.parametrize("title", ["crashes near 0, trainings differ by .15", "1 of 10 trainings crashes in 30 % more"])
def test_crash_rates_of_a_few_bad_trainings_are_inside_their_intervals(title: str, runs: int) -> None:
    assert coverage(BAD[title], runs, FEWER)["crash rate"] >= binom.ppf(0.0005, FEWER, 0.95)


@given(st.integers(3, 5), st.floats(0.3, 0.7), st.floats(-0.4, 0.4))
@settings(max_examples=40, deadline=None)
def test_few_trainings_that_are_all_alike_do_not_tell_one_training_apart(count: int, score: float, lead: float) -> None:
    several = np.full((count, 1, 30), score - lead / 2)
    assert 0 in independent(np.full((1, 1, 30), score + lead / 2), several)


def test_ten_alike_trainings_tell_one_apart_that_is_far_off() -> None:
    generator = np.random.default_rng(0)
    several = 0.6 + 0.02 * generator.standard_normal((10, 1, 1)) + 0.05 * generator.standard_normal((10, 1, 30))
    assert independent(several, np.full((1, 1, 30), 0.3)).low > 0
    assert 0 in independent(several, np.full((1, 1, 30), 0.57))
