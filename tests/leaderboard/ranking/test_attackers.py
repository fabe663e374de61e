"""The ranking of attacks: what each adds to all others, in all its variants, and what it costs."""

from __future__ import annotations

import pyarrow as pa
import pytest

from cavbench.leaderboard.ranking.attackers import Attacker, attackers, seconds
from cavbench.leaderboard.ranking.boards import read_boards
from tests.leaderboard.synthetic import CLEAR, drive

COMMON = {"cells": CLEAR[:3], "episodes": 10, "runs": (0, 1, 2)}


def ranked(*attacks: tuple[str, float, dict[str, object]], defenses: tuple[str, ...] = ("none",)) -> list[Attacker]:
    tables = []
    for defense in defenses:
        tables.append(drive(defense=defense, skill=0.9, **COMMON))  # type: ignore[arg-type]
        tables += [
            drive(attack=name, attack_params=params, defense=defense, skill=skill, queries=5.0, **COMMON)  # type: ignore[arg-type]
            for name, skill, params in attacks
        ]
    (board,), _ = read_boards({"driving": pa.concat_tables(tables)})
    return attackers(board)


def test_the_attack_that_lowers_the_score_furthest_adds_most_and_the_others_nothing() -> None:
    strong, weak = ranked(("plan", 0.2, {}), ("noise", 0.8, {}))
    assert (strong.name, weak.name) == ("plan", "noise")
    assert strong.added > 0.3
    assert weak.added == 0
    assert (strong.group, weak.group) == (1, 2)
    assert (strong.strongest, weak.strongest) == (1, 0)


def test_variants_of_an_attack_do_not_hide_what_it_adds() -> None:
    one, _ = ranked(("pgd", 0.2, {"steps": 1}), ("noise", 0.8, {}))
    two, _ = ranked(("pgd", 0.2, {"steps": 1}), ("pgd", 0.2, {"steps": 2}), ("noise", 0.8, {}))
    assert (two.name, two.variants, two.rows) == ("pgd", 2, 1)
    assert two.added == pytest.approx(one.added, abs=0.05)
    assert two.queries == pytest.approx(2 * one.queries)
    assert two.seconds == pytest.approx(2 * one.seconds)


def test_an_attack_without_others_adds_the_whole_fall() -> None:
    (alone,) = ranked(("zo", 0.3, {}), defenses=("none", "sa"))
    assert alone.rows == 2
    assert alone.added == pytest.approx(alone.alone)


def test_the_cost_counts_a_unit_once_not_once_an_episode() -> None:
    (one,) = ranked(("zo", 0.3, {}))
    (attack,) = one.attacks
    table = attack.own.table
    units = dict(zip(table["unit"].to_pylist(), table["wall_s"].to_pylist(), strict=True))
    assert seconds(attack) == pytest.approx(sum(units.values()) / table.num_rows)
