"""Paired differences: p-values belong to the intervals, and many tests at once keep their level."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavbench.statistics.estimates import components, interval
from cavbench.statistics.paired import LEVEL, holm, p_values


def studies(count: int, runs: int, scenarios: int, shift: float = 0.0, seed: int = 0) -> np.ndarray:
    """[count, R, E] differences with effects of trainings, unless there is one, and of scenarios."""
    rng = np.random.default_rng(seed)
    training, scenario = rng.normal(0, 0.1 * (runs > 1), (count, runs, 1)), rng.normal(0, 0.2, (count, 1, scenarios))
    return shift + training + scenario + rng.normal(0, 0.1, (count, runs, scenarios))


@pytest.mark.parametrize(("runs", "scenarios"), [(1, 10), (5, 10), (10, 1), (3, 20)])
def test_p_is_below_5_percent_exactly_where_the_95_percent_interval_leaves_out_0(runs: int, scenarios: int) -> None:
    differences = studies(200, runs, scenarios, shift=0.1)
    p = p_values(differences)
    left_out = [0 not in interval(one[:, None, :]) for one in differences]
    assert ((p < 0.05) == left_out).all()
    assert 0.1 < np.mean(left_out) < 1


@pytest.mark.parametrize(("runs", "scenarios"), [(1, 20), (5, 10), (10, 10)])
def test_equal_sides_are_called_different_in_5_percent_of_studies(runs: int, scenarios: int) -> None:
    p = p_values(studies(4000, runs, scenarios))
    assert 0.025 < (p < LEVEL).mean() < 0.065


def test_a_margin_at_the_tail_of_p_reaches_the_estimate() -> None:
    differences = studies(50, 4, 12, shift=0.2)
    margins = components(differences).margin(p_values(differences) / 2)
    assert np.allclose(margins, np.abs(differences.mean((1, 2))), rtol=1e-6)


def test_few_equal_differences_are_no_proof() -> None:
    assert p_values(np.full((1, 3), -1.0)) == pytest.approx(0.25)
    assert p_values(np.full((1, 10), -1.0)) == pytest.approx(2**-9)
    assert p_values(np.full((1, 1), -1.0)) == 1
    assert p_values(np.zeros((3, 10))) == 1


@given(p=st.lists(st.floats(0, 1), min_size=1, max_size=30))
def test_holm_keeps_the_order_and_lies_between_p_and_bonferroni(p: list[float]) -> None:
    raw = np.array(p)
    adjusted = holm(raw)
    assert (adjusted >= raw).all()
    assert (adjusted <= np.minimum(raw * len(raw), 1)).all()
    assert (np.diff(adjusted[np.argsort(raw, kind="stable")]) >= 0).all()


def test_many_equal_sides_hold_the_level_together() -> None:
    families = p_values(studies(6000, 3, 10)).reshape(300, 20)
    assert np.mean([(holm(family) < LEVEL).any() for family in families]) < 0.08


def test_holm_of_a_worked_example() -> None:
    assert holm(np.array([0.01, 0.04, 0.03, 0.005])) == pytest.approx([0.03, 0.06, 0.06, 0.02])
