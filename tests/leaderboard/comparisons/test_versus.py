"""Two sets of results side by side: what is paired, what is refused, and what is called better or worse."""

from __future__ import annotations

import json

import numpy as np
import pyarrow as pa
import pytest
from rich.console import Console

from cavbench.errors import UserError
from cavbench.leaderboard.comparisons.versus import Versus, compare
from cavbench.leaderboard.terminal.versus import below, markdown, print_versus
from tests.leaderboard.synthetic import CLEAR, GRID, drive, facts


def versus(first: list[pa.Table], second: list[pa.Table]) -> Versus:
    return compare(*({"driving": pa.concat_tables(side)} for side in (first, second)), names=("old", "new"))


def set_to(records: pa.Table, **columns: object) -> pa.Table:
    """The records with other values."""
    for name, value in columns.items():
        place = records.schema.get_field_index(name)
        values = [value] * records.num_rows if np.isscalar(value) else value
        records = records.set_column(
            place, records.schema.field(name), pa.array(values, records.schema.field(name).type)
        )
    return records


def with_scores(records: pa.Table, change: float, seed: int = 0) -> pa.Table:
    """The same scenarios, each scored higher by about so much."""
    scores = (
        records["safe_progress"].to_numpy() + change + np.random.default_rng(seed).normal(0, 0.02, records.num_rows)
    )
    return set_to(records, safe_progress=np.clip(scores, 0, 1).tolist())


CLEAN, PGD, ZO = drive(skill=0.7), drive(attack="pgd", skill=0.4), drive(attack="zo", skill=0.5)


def test_the_same_records_are_the_same() -> None:
    found = versus([CLEAN, PGD], [CLEAN, PGD])
    assert [(line.attack, line.difference.estimate, line.verdict) for line in found.rows] == [
        ("no attack", 0.0, "same"),
        ("pgd", 0.0, "same"),
    ]
    assert len(found.cells) == 2 * len(GRID.cells())
    assert (found.worse, found.left_out, found.remarks) == ([], (), ())


def test_differences_are_means_of_paired_scores_and_have_a_sign() -> None:
    found = versus([CLEAN, PGD, ZO], [with_scores(CLEAN, 0.1), with_scores(PGD, -0.1), ZO])
    rows = {line.attack: line for line in found.rows}
    assert {name: line.verdict for name, line in rows.items()} == {
        "no attack": "better",
        "pgd": "worse",
        "zo": "same",
        "strongest of 2": "worse",
    }
    pgd, changed = (records["safe_progress"].to_numpy().mean() for records in (PGD, with_scores(PGD, -0.1)))
    assert rows["pgd"].difference.estimate == pytest.approx(changed - pgd)
    assert rows["pgd"].difference.high < 0
    # The interval of paired differences is far narrower than those of the scores.
    widths = [line.high - line.low for line in (rows["pgd"].difference, rows["pgd"].first)]
    assert widths[0] < widths[1] / 2


def test_only_one_cell_that_changed_is_called_different() -> None:
    cell = PGD["cell"].to_pylist()
    better = with_scores(PGD, 0.4)["safe_progress"].to_pylist()
    scores = [
        new if one == cell[0] else old
        for one, new, old in zip(cell, better, PGD["safe_progress"].to_pylist(), strict=True)
    ]
    found = versus([PGD], [set_to(PGD, safe_progress=scores)])
    changed = [line for line in found.cells if line.verdict != "same"]
    assert [dict(line.cell or {}) for line in changed] == [json.loads(cell[0])]


def test_two_defences_are_compared_where_each_side_has_one() -> None:
    found = versus([CLEAN, PGD], [drive(defense="shield"), drive(attack="pgd", defense="shield")])
    assert {(line.defended, line.attack) for line in found.rows} == {
        ("dqn → dqn + shield", "no attack"),
        ("dqn → dqn + shield", "pgd"),
    }


def test_two_versions_of_an_attack_are_compared() -> None:
    other = drive(attack="pgd", attack_params={"steps": 50}, skill=0.3)
    found = versus([CLEAN, drive(attack="pgd", attack_params={"steps": 20}, skill=0.4)], [CLEAN, other])
    assert [line.attack for line in found.rows] == ["no attack", "pgd steps=20 → pgd steps=50"]


def test_access_that_an_attack_does_not_need_is_no_difference() -> None:
    found = versus([PGD], [set_to(PGD, threat_access="dynamics")])
    assert [line.verdict for line in found.rows] == ["same"]


def test_rows_that_only_one_side_has_are_named() -> None:
    found = versus([CLEAN, PGD, drive("ppo")], [CLEAN, ZO, PGD])
    assert set(found.left_out) == {"only old has ppo", "only new has zo on dqn"}


def test_scenarios_that_only_one_side_has_do_not_count() -> None:
    found = versus([drive(attack="pgd", cells=CLEAR, runs=(0, 1, 2, 3))], [drive(attack="pgd", episodes=10)])
    (row,) = found.rows
    assert row.shape == (3, len(CLEAR), 10)
    assert "episodes are left out" in found.remarks[-1]


def test_one_training_says_nothing_about_others() -> None:
    first, second = (drive(attack="pgd", runs=(0,), weights=name) for name in "ab")
    assert any("1 training seed" in remark for remark in versus([first], [second]).remarks)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (drive(attack="pgd", threat=("relative", 0.2)), r"threat_budget \(0.1 and 0.2\)"),
        (drive(attack="pgd", threat=("linf", 0.1)), r"threat_norm \(relative and linf\)"),
        (set_to(PGD, world="roundabout"), r"world \(highway and roundabout\)"),
        (set_to(PGD, world_params='{"preset": "dense"}'), r"world preset \(standard and dense\)"),
        (set_to(PGD, world_facts=facts(GRID, decision_hz=5, max_steps=450)), "worlds differ in"),
        (drive(attack="pgd", runs=(7, 8)), "no training seed in common"),
        (set_to(PGD, seed=(PGD["seed"].to_numpy() + 5000).tolist()), "no scenario in common"),
        (drive(attack="pgd", grid="audit"), "no records of public"),
    ],
)
def test_what_cannot_be_compared_is_refused_with_the_reason(other: pa.Table, said: str) -> None:
    with pytest.raises(UserError, match=said) as refused:
        versus([PGD], [other])
    assert "\n" not in str(refused.value)


def test_no_order_of_records_changes_a_number() -> None:
    tables = [CLEAN, PGD, ZO]
    changed = [with_scores(one, 0.05) for one in tables]
    shuffled = [one.take(np.random.default_rng(1).permutation(one.num_rows)) for one in changed[::-1]]
    assert versus(tables, changed).content() == versus(tables[::-1], shuffled).content()


def test_equal_methods_are_rarely_called_different() -> None:
    """Of 20 comparisons of three attacks on two equal trainings' sets, few say that anything changed."""
    called = 0
    for study in range(20):
        rng = np.random.default_rng(study)

        def side(rng: np.random.Generator = rng) -> list[pa.Table]:
            of_run, of_seed = rng.normal(0, 0.05, 3), np.random.default_rng(7).normal(0, 0.1, 20)
            noise = rng.normal(0, 0.05, (3, len(CLEAR), 20))
            scores = np.clip(0.5 + of_run[:, None, None] + of_seed + noise, 0, 1).ravel().tolist()
            return [set_to(drive(attack=name, cells=CLEAR), safe_progress=scores) for name in ("pgd", "zo", "noise")]

        called += any(line.verdict != "same" for line in versus(side(), side()).rows)
    assert called <= 4


def test_the_table_fits_80_columns_and_says_what_follows() -> None:
    console = Console(width=80, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    found = versus([CLEAN, PGD, ZO], [with_scores(CLEAN, 0.1), with_scores(PGD, -0.1), ZO])
    print_versus(found, console)
    text = console.export_text()
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    assert "✗ worse" in text
    assert any(line.startswith("B is significantly worse: dqn (pgd") for line in below(found))


def test_markdown_shows_hostile_names_as_text() -> None:
    hostile = "a|b<script>`"
    text = markdown(versus([drive(hostile)], [drive(hostile)]))
    assert "<script>" not in text
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in rows} == {9}
