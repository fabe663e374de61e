"""Properties of scores on the scale between two references."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cavbench.statistics.estimates import Array
from cavbench.statistics.scaled import has_scale, mean_of, over_worlds, scaled

SHAPE = (2, 3, 4)
shares = st.floats(0, 1, allow_nan=False, width=32)
episodes = arrays(np.float64, SHAPE, elements=shares)
LOW, HIGH = np.full(SHAPE[1:], 0.25), np.full(SHAPE[1:], 0.75)


@given(episodes)
def test_the_parts_have_the_mean_of_the_share_cut_to_0_and_1(scores: Array) -> None:
    share = (scores.mean() - 0.25) / 0.5
    parts = scaled(scores, LOW, HIGH)
    assert parts.shape == (2, 4)
    assert parts.mean() == pytest.approx(min(max(share, 0), 1), abs=1e-9)


@given(episodes, arrays(np.float64, SHAPE, elements=st.floats(0, 0.5, allow_nan=False)))
def test_a_higher_score_in_any_episode_never_has_a_lower_share(scores: Array, more: Array) -> None:
    assert scaled(scores + more, LOW, HIGH).mean() >= scaled(scores, LOW, HIGH).mean() - 1e-9


def test_the_references_themselves_are_0_and_1() -> None:
    generator = np.random.default_rng(1)
    low, high = generator.uniform(0, 0.4, (3, 10)), generator.uniform(0.6, 1, (3, 10))
    assert np.allclose(scaled(low[None], low, high), 0)
    assert np.allclose(scaled(high[None], low, high), 1)


def test_equal_references_are_no_scale_and_neither_are_those_that_differ_by_luck() -> None:
    generator = np.random.default_rng(2)
    low = generator.uniform(0, 1, (2, 8))
    assert not has_scale(low, low)
    assert not has_scale(low, generator.permutation(low.ravel()).reshape(2, 8))
    assert not has_scale(low[:, :1], low[:, :1] + 0.5), "one scenario shows no variance"
    assert has_scale(low, low + generator.uniform(0.3, 0.5, (2, 8)))


@given(st.permutations(range(4)))
def test_the_order_of_worlds_changes_no_number(order: list[int]) -> None:
    generator = np.random.default_rng(3)
    parts = [generator.uniform(0, 1, (3, 5 + world)) for world in range(4)]
    found, other = mean_of(over_worlds(parts)), mean_of(over_worlds([parts[n] for n in order]))
    for name in ("estimate", "low", "high"):
        assert getattr(found, name) == pytest.approx(getattr(other, name), abs=1e-12)


def test_one_run_and_one_scenario_have_no_interval() -> None:
    found = mean_of(over_worlds([np.full((1, 1), 0.5), np.full((1, 1), 0.7)]))
    assert found.estimate == pytest.approx(0.6)
    assert math.isnan(found.low)


@pytest.mark.parametrize("shared", [True, False], ids=["one training everywhere", "another in each world"])
def test_the_interval_holds_the_truth_as_often_as_it_says(shared: bool) -> None:
    generator = np.random.default_rng(4)
    worlds, runs, cells, seeds, studies = 5, 5, 3, 10, 400
    truth, held = 0.5, 0
    for _ in range(studies):
        luck = generator.normal(0, 0.08, (1 if shared else worlds, runs, 1, 1)) * np.ones((worlds, 1, 1, 1))
        scenario = generator.normal(0, 0.15, (worlds, 1, cells, seeds))
        low = 0.2 + generator.normal(0, 0.1, (worlds, cells, seeds))
        high = 0.8 + generator.normal(0, 0.03, (worlds, cells, seeds))
        scores = truth + luck + scenario + generator.normal(0, 0.1, (worlds, runs, cells, seeds))
        held += truth in mean_of(over_worlds([scaled(*one) for one in zip(scores, low, high, strict=True)]))
    assert 0.92 <= held / studies <= 0.985, held / studies
