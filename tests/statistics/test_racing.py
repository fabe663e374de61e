"""Racing: who goes on, whether records followed the rule, and a bound of what a race may hide."""

from __future__ import annotations

import numpy as np
import pytest

from cavbench.statistics.racing import KEPT, by_the_rule, hidden, kept
from cavbench.statistics.strongest import strongest_of, under


def drawn(rng: np.random.Generator, attacks: int, runs: int, scenarios: int) -> np.ndarray:
    """[A, R, C, E]: attacks of about the same strength, each better in some cells, on shared traffic and trainings."""
    cells = 18
    means = 0.4 + 0.05 * rng.standard_normal((attacks, 1, 1, 1)) + 0.05 * rng.standard_normal((attacks, 1, cells, 1))
    shared = 0.1 * rng.standard_normal((1, runs, 1, 1)) + 0.2 * rng.standard_normal((1, 1, cells, scenarios))
    return np.clip(means + shared + 0.1 * rng.standard_normal((attacks, runs, cells, scenarios)), 0, 1)


def test_the_strongest_go_on_and_all_that_equal_the_last_of_them() -> None:
    scores = np.broadcast_to(np.array([0.5, 0.2, 0.3, 0.9])[:, None, None, None], (4, 2, 3, 10))
    assert kept(scores) == [1, 2]
    assert kept(scores[[0, 1, 0, 3]]) == [1, 0, 2]
    assert kept(np.zeros((5, 1, 1, 10))) == [0, 1, 2, 3, 4]


def test_who_goes_on_does_not_depend_on_the_order_of_the_attacks() -> None:
    rng = np.random.default_rng(0)
    scores = drawn(rng, 6, 3, 10)
    order = rng.permutation(6)
    assert [int(order[place]) for place in kept(scores[order])] == kept(scores)


def test_records_follow_the_rule_only_if_the_strongest_went_on() -> None:
    scores = drawn(np.random.default_rng(1), 5, 2, 10)
    first, second, *others = np.argsort(scores.mean((1, 2, 3))).tolist()
    assert by_the_rule(scores, [first, second])
    assert by_the_rule(scores, [second, others[0], first])
    assert by_the_rule(scores, [first, second, others[-1]]), (
        "a weaker one that has all scenarios can only lower the score"
    )
    assert not by_the_rule(scores, [first])
    assert not by_the_rule(scores, [first, others[0]])
    assert not by_the_rule(scores, [second, others[0], others[1]])


def test_equals_of_which_one_did_not_go_on_do_not_follow_the_rule() -> None:
    assert not by_the_rule(np.zeros((3, 1, 2, 10)), [0, 1])
    assert by_the_rule(np.zeros((3, 1, 2, 10)), [0, 1, 2])


@pytest.mark.parametrize("runs", [1, 5])
def test_the_score_of_a_race_is_too_high_by_more_than_the_bound_in_few_races(runs: int) -> None:
    rng = np.random.default_rng(runs)
    above, bounds, losses = 0, [], []
    for _ in range(100):
        every = drawn(rng, 12, runs, 400)
        pilot = every[..., :10]
        on = every[kept(pilot)]
        # Against the truth, chosen with all scenarios.
        loss = under(strongest_of(on), on).mean() - under(strongest_of(every), every).mean()
        bounds.append(hidden(pilot))
        losses.append(loss)
        above += loss > bounds[-1]
    assert len(on) == KEPT
    assert 0 < np.mean(losses) < np.mean(bounds) < 0.1
    # At 97.5 %, more than 6 of 100 are seen in fewer than 1 of 40 repetitions.
    assert above <= 6


def test_attacks_that_never_differ_hide_nothing() -> None:
    scores = np.broadcast_to(np.random.default_rng(0).random((1, 2, 3, 10)), (4, 2, 3, 10))
    assert hidden(scores) == 0.0
