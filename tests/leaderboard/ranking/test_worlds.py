"""The rank over worlds: made-up records of several worlds, whose roads are those of the highway."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.leaderboard.ranking.worlds import WorldBoard, WorldRow, over_several
from tests.leaderboard.several_worlds import attacked, references, scores


def worlds(*tables: Sequence[pa.Table]) -> WorldBoard:
    boards, _ = read_boards({"driving": pa.concat_tables([one for several in tables for one in several])})
    (found,) = over_several(boards)
    return found


def of(board: WorldBoard, victim: str) -> WorldRow:
    return next(row for row in board.rows if row.method.victim == victim)


def test_the_mean_is_that_of_the_shares_between_the_blind_policy_and_perfect_information() -> None:
    board = worlds(
        attacked("dqn", "merge", 0.55), references("merge"), attacked("dqn", "exit", 0.3), references("exit", 0.1, 0.5)
    )
    (row,) = board.rows
    assert row.places["merge"].share == pytest.approx((0.55 - 0.2) / 0.7, abs=0.01)
    assert row.places["exit"].share == pytest.approx((0.3 - 0.1) / 0.4, abs=0.01)
    assert row.mean is not None
    assert row.mean.estimate == pytest.approx(0.5, abs=0.01)
    assert row.mean.low < 0.5 < row.mean.high
    assert row.group == 1
    assert row.worst is not None
    assert row.worst[0] in ("exit", "merge")


def test_what_is_worse_than_blind_is_worth_nothing_and_no_less() -> None:
    board = worlds(
        attacked("dqn", "merge", 0.05), references("merge"), attacked("dqn", "exit", 0.95), references("exit")
    )
    (row,) = board.rows
    assert [row.places[name].share for name in ("exit", "merge")] == pytest.approx([1, 0])
    assert row.worst == ("merge", pytest.approx(0))
    assert row.mean is not None
    assert row.mean.estimate == pytest.approx(0.5)


def test_a_row_that_lacks_a_world_says_which_and_has_no_rank() -> None:
    board = worlds(
        *(attacked("dqn", name, 0.5) for name in ("merge", "exit")),
        *(references(name) for name in ("merge", "exit")),
        attacked("planner", "merge", 0.85),
    )
    assert [(row.method.victim, row.group) for row in board.rows] == [("dqn", 1), ("planner", 0)]
    lone = of(board, "planner")
    assert lone.lacks == {"exit": "not driven"}
    assert lone.mean is None
    assert lone.worst is None


def test_attacks_that_ask_nothing_make_no_score_under_attack() -> None:
    ends = [references(name) for name in ("merge", "exit")]
    noise = [attacked("dqn", name, 0.5, "noise") for name in ("merge", "exit")]
    (row,) = worlds(*noise, *ends).rows
    assert row.group == 0
    assert set(row.lacks.values()) == {"no attack that it met in all of its worlds asked it anything (noise)"}
    # Another attack in each world: the row met none of them in both.
    asked = [[scores("dqn", name, 0.4, attack=one, queries=9.0)] for name, one in (("merge", "pgd"), ("exit", "zo"))]
    (row,) = worlds(*noise, *asked, *ends).rows
    assert row.group == 0
    (row,) = worlds(*asked, *([scores("dqn", name, 0.7)] for name in ("merge", "exit")), *ends).rows
    assert set(row.lacks.values()) == {"no attack was driven in all of its worlds"}


def test_only_attacks_that_a_row_met_in_all_of_its_worlds_count() -> None:
    both = [attacked("dqn", name, 0.6) for name in ("merge", "exit")]
    board = worlds(
        *both, references("merge"), references("exit"), [scores("dqn", "merge", 0.3, attack="plan", queries=9.0)]
    )
    (row,) = board.rows
    assert row.attacks == ("pgd",)
    assert row.places["merge"].share == pytest.approx((0.6 - 0.2) / 0.7, abs=0.01)


def test_a_world_whose_references_are_equal_counts_for_nobody() -> None:
    tables = [attacked("dqn", name, 0.5) for name in ("merge", "exit", "u_turn")]
    ends = [references("merge"), references("exit"), references("u_turn", 0.5, 0.5)]
    board = worlds(*tables, *ends)
    assert list(board.without_scale) == ["u_turn"]
    assert "not significantly better" in board.without_scale["u_turn"]
    (row,) = board.rows
    assert row.group == 1
    assert row.places["u_turn"].share is None
    without = worlds(*tables[:2], *ends[:2])
    assert row.mean == without.rows[0].mean


def test_a_reference_that_was_not_driven_is_asked_for() -> None:
    board = worlds(*(attacked("dqn", name, 0.5) for name in ("merge", "exit")), references("merge", perfect=None))
    assert board.without_scale["merge"].endswith("bench run world=merge victim=clairvoyant attack=none")
    assert "reference=false" in board.without_scale["exit"]
    assert [row.group for row in board.rows] == [0]


def test_a_policy_that_was_trained_in_each_world_is_another_method_than_one_that_was_trained_in_one() -> None:
    here, there = {"trained_in": ""}, {"trained_in": "merge"}
    board = worlds(
        attacked("dqn", "highway", 0.6, victim_params=here),
        attacked("dqn", "merge", 0.4, victim_params=here),
        attacked("dqn", "merge", 0.7, victim_params=there),
        references("highway"),
        references("merge"),
    )
    assert [(row.method.home, row.group) for row in board.rows] == [("each world", 1), ("highway", 2)]
    assert [list(row.places) for row in board.rows] == [["highway", "merge"]] * 2


def test_a_world_with_its_default_parameters_is_named_without_them() -> None:
    """Those that it has from a base class, too; otherwise no policy would be at home there."""
    given = '{"connected": true, "target_speeds": [10.0, 15.0, 20.0, 25.0, 30.0]}'
    tables = [*attacked("dqn", "merge", 0.5, victim_params={"trained_in": "merge"}), *references("merge")]
    place = tables[0].schema.get_field_index("world_params")
    field = tables[0].schema.field(place)
    tables = [one.set_column(place, field, pa.array([given] * one.num_rows, field.type)) for one in tables]
    board = worlds(tables, attacked("dqn", "highway", 0.5, victim_params={"trained_in": ""}), references("highway"))
    assert list(board.grids) == ["highway", "merge"]
    assert [row.method.home for row in board.rows] == ["each world"]


def test_rows_are_told_apart_only_by_a_significant_difference() -> None:
    ends = [references(name) for name in ("merge", "exit")]
    close = worlds(*(attacked(victim, name, 0.5) for victim in ("dqn", "ppo") for name in ("merge", "exit")), *ends)
    assert [row.group for row in close.rows] == [1, 1]
    far = {"dqn": 0.8, "ppo": 0.45}
    apart = worlds(*(attacked(victim, name, far[victim]) for victim in far for name in ("merge", "exit")), *ends)
    assert [(row.method.victim, row.group) for row in apart.rows] == [("dqn", 1), ("ppo", 2)]
    once = worlds(
        *(attacked(victim, name, far[victim], runs=(0,), weights="a") for victim in far for name in ("merge", "exit")),
        *ends,
    )
    assert [row.group for row in once.rows] == [1, 1], "one training says nothing of others"


@settings(max_examples=4, deadline=None)
@given(st.permutations(["merge", "exit", "two_way"]), st.floats(0, 0.3))
def test_no_order_of_worlds_changes_a_number_and_a_better_score_never_lowers_the_mean(
    order: list[str], better: float
) -> None:
    means = {"merge": 0.4, "exit": 0.55, "two_way": 0.3}

    def mean(names: Sequence[str], more: float = 0.0) -> Any:
        made = [[*attacked("dqn", name, means[name] + more), *references(name)] for name in names]
        return worlds(*made).rows[0].mean

    plain = mean(list(means))
    assert mean(order) == plain
    assert mean(order, better).estimate >= plain.estimate - 1e-9


def test_one_world_alone_has_no_leaderboard_over_worlds() -> None:
    boards, _ = read_boards({"driving": pa.concat_tables([*attacked("dqn", "merge", 0.5), *references("merge")])})
    assert over_several(boards) == []
