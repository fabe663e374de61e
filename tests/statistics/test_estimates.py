"""Statistics and driving metrics: known values, and what must hold for any records."""

from __future__ import annotations

import json

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import binomtest, ttest_1samp

from cavbench.core.contracts import Facts
from cavbench.core.track import Measure
from cavbench.envs.highway.axes import AXES
from cavbench.scenarios import Cell
from cavbench.statistics.episodes import Episodes, as_text, difference, measured, shared
from cavbench.statistics.estimates import components, interval, share_interval, task_intervals

quick = settings(max_examples=40, deadline=None)
shapes = st.tuples(st.integers(1, 5), st.integers(1, 6), st.integers(1, 8))
scores = shapes.flatmap(lambda shape: arrays(np.float64, shape, elements=st.floats(0, 1, width=32)))


def cell_of(number: int) -> Cell:
    """Cells in an order other than that of tables."""
    weather = ("clear", "rain", "fog")[number // 6]
    return Cell(lanes=3 + int(number) % 3, density=1.0 + int(number) // 3 % 2, weather=weather)


def episodes(values: np.ndarray, first_seed: int = 100, shift: float = 0.0) -> pa.Table:
    """Records whose `safe_progress` is values [R, C, E]."""
    runs, cells, count = values.shape
    run, cell, seed = (index.ravel() for index in np.indices(values.shape))
    rows = runs * cells * count
    return pa.table(
        {
            "training_seed": run,
            "cell": [as_text(cell_of(number)) for number in cell],
            "world_facts": [json.dumps(Facts(axes=AXES).written())] * rows,
            "seed": first_seed + seed,
            "safe_progress": values.ravel() + shift,
            "return": 450 * values.ravel(),
            "crashed": values.ravel() < 0.2,
            "offroad": np.zeros(rows, bool),
            "steps": np.full(rows, 450),
            "changed": values.ravel() / 2,
            "queries": np.full(rows, 7.0),
            "queries_median": np.full(rows, 7.0),
            "queries_max": np.full(rows, 9.0),
            "attack_ms": np.full(rows, 1.5),
            "min_ttc_s": np.where(values.ravel() > 0.5, np.inf, values.ravel()),
            "mean_speed": np.full(rows, 25.0),
            "action_counts": pa.array([[450, 0, 0, 0, 0]] * rows, pa.list_(pa.int32())),
        }
    )


@given(scores)
@quick
def test_an_interval_holds_its_estimate(values: np.ndarray) -> None:
    for result in (interval(values), share_interval(values)):
        assert np.isnan(result.low) or result.low <= result.estimate <= result.high
        assert result.estimate == pytest.approx(values.mean())
    assert np.isnan(result.low) or 0 <= result.low <= result.high <= 1


def test_one_number_has_no_interval() -> None:
    result = interval(np.full((1, 3, 1), 0.5))
    assert result.estimate == 0.5
    assert np.isnan(result.low)
    assert np.isnan(result.high)


@pytest.mark.parametrize("alone", ["runs", "scenarios"])
def test_with_one_random_factor_it_is_students_interval(alone: str) -> None:
    values = np.random.default_rng(0).random((5, 4))
    scores = values[:, :, None] if alone == "runs" else values.T[None]
    expected = ttest_1samp(values.mean(1), 0).confidence_interval(0.95)
    result = interval(scores)
    assert (result.low, result.high) == pytest.approx((expected.low, expected.high))


def test_the_components_are_those_of_a_crossed_design() -> None:
    # Montgomery, "Design and Analysis of Experiments", two-factor random effects without replicates: by hand.
    means = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]])
    found = components(means)
    by_run, by_scenario, rest = 3 * (1 + 1) / 1, 2 * (1.5**2 + 1.5**2) / 2, (0.5**2 * 4) / 2
    assert float(found.training) == pytest.approx(by_run / 6)
    assert float(found.scenario) == pytest.approx((by_scenario - rest) / 6)


def test_a_policy_that_is_lucky_in_every_cell_is_one_policy() -> None:
    """Eighteen cells of three policies are three trainings, not fifty-four."""
    one_cell = np.random.default_rng(0).random((3, 1, 50)) * 0.01 + np.array([0.2, 0.5, 0.8])[:, None, None]
    eighteen = np.repeat(one_cell, 18, 1)
    assert interval(eighteen) == interval(one_cell)
    assert interval(eighteen).high - interval(eighteen).low > 1


@given(scores)
@quick
def test_the_intervals_of_cells_are_those_of_each_alone(values: np.ndarray) -> None:
    for share, alone in ((True, share_interval), (False, interval)):
        for place, found in enumerate(task_intervals(values, share=share)):
            expected = alone(values[:, [place]])
            assert (found.estimate, found.low, found.high) == pytest.approx(
                (expected.estimate, expected.low, expected.high), nan_ok=True, abs=1e-9
            )


@given(st.integers(2, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
@quick
def test_independent_episodes_of_one_driver_have_nearly_wilsons_interval(counts: tuple[int, int]) -> None:
    successes, trials = counts
    outcomes = np.zeros(trials)
    outcomes[:successes] = 1
    found = share_interval(outcomes[None, None])
    expected = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    assert 0 <= found.low <= found.estimate <= found.high <= 1
    assert found.high - found.low > 0
    if trials > 50:
        assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=0.02)


@pytest.mark.parametrize("bad", [np.zeros((2, 3)), np.zeros((0, 3, 2)), np.full((1, 1, 1), np.nan)])
def test_scores_that_mean_nothing_are_refused(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="scores must be"):
        interval(bad)


@given(scores, st.randoms(use_true_random=False))
@quick
def test_the_order_of_the_records_does_not_matter(values: np.ndarray, random: object) -> None:
    table = episodes(values)
    rows = list(range(table.num_rows))
    random.shuffle(rows)  # type: ignore[attr-defined]
    ordered, mixed = Episodes.arrange(table), Episodes.arrange(table.take(rows))
    assert ordered.table.equals(mixed.table)
    assert share_interval(ordered.column("safe_progress")) == share_interval(mixed.column("safe_progress"))


@given(scores)
@quick
def test_columns_come_back_as_runs_cells_episodes(values: np.ndarray) -> None:
    arranged = Episodes.arrange(episodes(values))
    assert arranged.shape == values.shape
    cells = list(arranged.cells)
    for c in range(values.shape[1]):
        cell = Cell(lanes=3 + c % 3, density=1.0 + c // 3, weather="clear")
        np.testing.assert_array_equal(arranged.column("safe_progress")[:, cells.index(cell)], values[:, c])


def test_what_a_run_lacks_is_left_out_of_all_runs() -> None:
    table = episodes(np.random.default_rng(0).random((2, 3, 4)))
    last = np.array(['"lanes":5' in cell for cell in table["cell"].to_pylist()])
    broken_off = table.filter(pa.array(~((table["training_seed"].to_numpy() == 1) & last)))
    arranged = Episodes.arrange(broken_off)
    assert [cell.lanes for cell in arranged.cells] == [3, 4]
    assert arranged.left_out == 4


@pytest.mark.parametrize(
    "stray",
    [
        {"training_seed": [7], "cell": [0], "seed": [100, 101, 102, 103]},
        {"training_seed": [0, 1], "cell": [5], "seed": [100]},
        {"training_seed": [0], "cell": [0], "seed": [200, 201]},
    ],
)
def test_a_stray_partial_run_changes_nothing(stray: dict[str, list[int]]) -> None:
    table = episodes(np.random.default_rng(0).random((2, 3, 4)))
    rows = [(run, cell, seed) for run in stray["training_seed"] for cell in stray["cell"] for seed in stray["seed"]]
    more = table.slice(0, 1).to_pylist()[0]
    strays = [
        more | {"training_seed": run, "cell": as_text(cell_of(cell)), "seed": seed, "safe_progress": 1.0}
        for run, cell, seed in rows
    ]
    arranged = Episodes.arrange(pa.concat_tables([table, pa.Table.from_pylist(strays, table.schema)]))
    assert arranged.table.equals(Episodes.arrange(table).table)
    assert arranged.left_out == len(rows)


def test_records_of_two_pairs_are_refused() -> None:
    table = episodes(np.ones((1, 1, 2)))
    with pytest.raises(ValueError, match="twice"):
        Episodes.arrange(pa.concat_tables([table, table]))


@given(scores, st.floats(-0.5, 0.5))
@quick
def test_a_constant_effect_is_found_exactly_in_pairs(values: np.ndarray, effect: float) -> None:
    control, treated = Episodes.arrange(episodes(values)), Episodes.arrange(episodes(values, shift=effect))
    result = difference(treated, control, "safe_progress")
    assert result.estimate == pytest.approx(effect, abs=1e-6)
    if not np.isnan(result.low):
        assert result.high - result.low == pytest.approx(0, abs=1e-6)


def test_pairing_refuses_other_scenarios() -> None:
    values = np.random.default_rng(0).random((2, 2, 4))
    first, second = Episodes.arrange(episodes(values)), Episodes.arrange(episodes(values, first_seed=101))
    with pytest.raises(ValueError, match="not paired"):
        difference(first, second, "safe_progress")
    first, second = shared(first, second)
    assert first.seeds == second.seeds == (101, 102, 103)
    difference(first, second, "safe_progress")


def test_pairing_refuses_other_training_seeds() -> None:
    three = Episodes.arrange(episodes(np.random.default_rng(0).random((3, 2, 4))))
    with pytest.raises(ValueError, match="not paired"):
        difference(three, three.only(runs=[0, 1]), "safe_progress")


def test_a_blind_driver_stands_for_every_run_and_weather() -> None:
    values = np.random.default_rng(0).random((3, 12, 4))
    learner, blind = Episodes.arrange(episodes(values)), Episodes.arrange(episodes(values[:1, :6]))
    stand_in = blind.standing_for(learner.runs, learner.cells)
    assert (stand_in.runs, stand_in.cells, stand_in.seeds) == (learner.runs, learner.cells, learner.seeds)
    difference(learner, stand_in, "safe_progress")
    np.testing.assert_array_equal(
        stand_in.only(runs=[2]).column("safe_progress")[0, 6:], blind.column("safe_progress")[0]
    )
    with pytest.raises(ValueError, match="never driven: lanes 3, density 4, clear"):
        blind.standing_for([0], [Cell(lanes=3, density=4.0, weather="clear")])


def test_rates_near_zero_keep_an_interval() -> None:
    crashes = Measure(column="crashed", heading="crashed", unit="share")
    never = measured(Episodes.arrange(episodes(np.full((1, 1, 100), 0.6))), crashes)
    assert never.high == pytest.approx(0.037, abs=0.001)
    assert share_interval(np.zeros((1, 1, 100))).high == pytest.approx(0.037, abs=0.001)
    always = measured(Episodes.arrange(episodes(np.zeros((2, 1, 50)))), crashes)
    assert always.low == pytest.approx(0.963, abs=0.001)


def test_each_way_of_measuring_is_what_it_says() -> None:
    values = np.array([[[0.0, 1.0, 0.25, 0.25]]])
    table = episodes(values)
    table = table.set_column(table.column_names.index("steps"), "steps", pa.array([100, 300, 100, 100]))
    arranged = Episodes.arrange(table)
    expected = {"mean": 0.375, "median": 0.25, "step mean": (300 + 25 + 25) / 600}
    for how, value in expected.items():
        found = measured(arranged, Measure(column="safe_progress", heading="", how=how))  # type: ignore[arg-type]
        assert found.estimate == pytest.approx(value)
        assert np.isnan(found.low) == (how != "mean")
