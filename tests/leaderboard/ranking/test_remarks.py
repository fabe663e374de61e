"""What stands under every table: doubts from the records alone."""

from __future__ import annotations

from io import StringIO

import numpy as np
import pyarrow as pa
import pytest
from rich.console import Console

from cavbench.core.track import track
from cavbench.leaderboard.comparisons.reading import distinct, read_comparisons
from cavbench.leaderboard.ranking.boards import boards
from cavbench.leaderboard.ranking.remarks import run_remarks
from cavbench.leaderboard.terminal.ranking import leaderboard_report
from cavbench.leaderboard.terminal.run import cells_report, run_report
from cavbench.statistics import doubts
from tests.leaderboard.synthetic import CLEAR, drive, probed

SMALL = {"cells": CLEAR[:2], "episodes": 5, "weights": "w"}
DRIVING = track("driving")


def names(*tables: pa.Table) -> set[str]:
    return {one.name for one in run_remarks(read_comparisons(pa.concat_tables(tables), DRIVING))}


def printed(*tables: pa.Table) -> str:
    console = Console(width=100, record=True, file=StringIO())
    run_report({"driving": pa.concat_tables(tables)}, console)
    cells_report({"driving": pa.concat_tables(tables)}, console)
    return " ".join(console.export_text().split())


def pair(params: dict[str, object] | None = None, **probes: float) -> list[pa.Table]:
    clean, attacked = (
        drive(attack=attack, skill=skill, queries=queries, victim_params=params, **SMALL)
        for attack, skill, queries in (("none", 0.9, 0.0), ("pgd", 0.3, 9.0))
    )
    return [probed(clean, nan_gradients=0.0), probed(attacked, **{"nan_gradients": 0.0} | probes)]


def test_honest_records_have_no_remark() -> None:
    assert names(*pair()) == set()


@pytest.mark.parametrize(
    ("probe", "value", "name", "words"),
    [
        ("zero_gradients", 0.6, "zero_gradients", "gradients are zero"),
        ("nan_gradients", 0.01, "nan_gradients", "an entry that is NaN or infinite"),
        ("inconsistent", 0.89, "two_faced", "its answers to attacks differ from its actions"),
    ],
)
def test_a_doubt_stands_under_every_table_of_a_run(probe: str, value: float, name: str, words: str) -> None:
    tables = pair(**{probe: value})
    assert names(*tables) == {name}
    assert printed(*tables).count(words) == 2


@pytest.mark.parametrize(
    ("trained_in", "name", "words"),
    [
        ("unknown", "provenance", "state it with victim.trained_in=…"),
        ("highway-fast-v0", "trained_elsewhere", "trained in highway-fast-v0, scored in highway"),
        ("highway(preset=thesis)", "trained_elsewhere", "trained in highway(preset=thesis), scored in highway"),
        ("highway", "", ""),
    ],
)
def test_a_table_says_where_a_victim_from_outside_was_trained(trained_in: str, name: str, words: str) -> None:
    tables = pair({"trained_in": trained_in})
    assert names(*tables) == ({name} if name else set())
    assert words in printed(*tables)


def test_a_control_that_does_nothing_and_baselines_that_all_fail_are_said() -> None:
    never = [probed(one, safe_progress=0.0) for one in pair()]
    assert names(*never) == {"hopeless"}
    idm = drive("idm", sees=False, runs=(0,), cells=CLEAR[:2], episodes=5)
    crashed = pa.array(np.ones(idm.num_rows, bool))
    failing = idm.set_column(idm.schema.get_field_index("crashed"), idm.schema.field("crashed"), crashed)
    assert {one.name for one in doubts.of_baselines([failing], DRIVING)} == {"baselines_fail"}
    assert not list(doubts.of_baselines([failing, idm], DRIVING))


def test_a_victim_that_does_nothing_without_an_attack_has_no_rank() -> None:
    blind = [probed(one, safe_progress=0.0) for one in pair({"hidden": 64})]
    with_rank, without = boards(read_comparisons(pa.concat_tables([*pair(), *blind]), DRIVING))[0].rows
    assert (with_rank.group, with_rank.hopeless) == (1, False)
    assert (without.group, without.hopeless) == (0, True)
    console = Console(width=120, record=True, file=StringIO())
    leaderboard_report({"driving": pa.concat_tables([*pair(), *blind])}, console)
    said = " ".join(console.export_text().split())
    assert "its safe progress is 0 in every scenario without an attack, so it has no rank" in said


def test_a_score_above_its_members_is_explained() -> None:
    (remark,) = doubts.above_members(0.95, {"zo": 0.85, "pgd": 0.9})
    assert "is above 0.850 under zo alone" in remark.text
    assert not list(doubts.above_members(0.85, {"zo": 0.85, "pgd": 0.9}))


def test_the_same_network_under_several_seeds_is_one_training() -> None:
    one = drive(runs=(0,), **SMALL)
    place = one.schema.get_field_index("training_seed")
    again = one.set_column(place, one.schema.field("training_seed"), pa.array([1] * one.num_rows))
    attacked = drive(attack="zo", runs=(0, 1), queries=4.0, **SMALL)
    kept = distinct(pa.concat_tables([one, again, attacked]), DRIVING)
    assert set(kept["training_seed"].to_pylist()) == {0}
    other = drive(runs=(0, 1), **SMALL)
    assert distinct(pa.concat_tables([other, attacked]), DRIVING).num_rows == other.num_rows + attacked.num_rows
