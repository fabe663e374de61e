"""No order of anything changes a number: of attacks, of training seeds, of cells, of files or of records."""

from __future__ import annotations

from functools import cache
from io import StringIO

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from cavbench.leaderboard.page.document import document
from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.leaderboard.terminal.ranking import print_boards
from cavbench.leaderboard.terminal.run import run_report
from cavbench.statistics.strongest import strongest_of, under
from tests.leaderboard.synthetic import CLEAR, baseline_drivers, drive

few = settings(max_examples=12, deadline=None)


def records() -> list[pa.Table]:
    """Tables of two victims whose attacks leave 0 or nearly so in most cells, with equal attacks among them."""
    common = {"cells": CLEAR[:3], "episodes": 6, "weights": "w", "runs": (0, 1)}
    found = [baseline_drivers(cells=CLEAR[:3], episodes=6)]
    for defense in ("none", "sa", "car"):
        found.append(drive(defense=defense, skill=0.7, **common))
        for number, attack in enumerate(("zo", "pgd", "plan", "rehearse")):
            found.append(drive(attack=attack, defense=defense, skill=0.02 * (number % 2), queries=5.0, **common))
        found.append(
            drive(attack="pgd", attack_params={"steps": 9}, defense=defense, skill=0.02, queries=9.0, **common)
        )
    return found


TABLES = records()


def said(tables: list[pa.Table]) -> tuple[object, str]:
    """The whole document, and what the terminal prints."""
    found, comparisons = read_boards({"driving": pa.concat_tables(tables)})
    made = document(found, comparisons, None)
    console = Console(width=200, record=True, file=StringIO())
    print_boards(found, console)
    run_report({"driving": pa.concat_tables(tables)}, console)
    return made, console.export_text()


@cache
def expected() -> tuple[object, str]:
    """What is said of the tables in their own order; not while tests are collected, which every process does."""
    return said(TABLES)


@given(st.permutations(range(len(TABLES))))
@few
def test_no_order_of_attacks_victims_or_files_changes_a_table(order: list[int]) -> None:
    assert said([TABLES[place] for place in order]) == expected()


@given(st.integers(0, 2**31))
@few
def test_no_order_of_records_changes_a_table(seed: int) -> None:
    generator = np.random.default_rng(seed)
    shuffled = [table.take(pa.array(generator.permutation(table.num_rows))) for table in TABLES]
    assert said(shuffled) == expected()


scores = st.integers(0, 2**31).map(
    lambda seed: np.random.default_rng(seed).choice([0.0, 0.0, 0.0, 0.1, 0.7], size=(5, 3, 4, 7))
)


@given(scores, st.permutations(range(5)), st.permutations(range(3)), st.permutations(range(4)))
@settings(max_examples=60, deadline=None)
def test_the_strongest_attack_depends_on_no_order(
    values: np.ndarray, attacks: list[int], runs: list[int], cells: list[int]
) -> None:
    found = under(strongest_of(values), values)
    moved = values[np.ix_(attacks, runs, cells)]
    again = under(strongest_of(moved), moved)
    assert again == pytest.approx(found[np.ix_(runs, cells)], abs=1e-12)


def test_equal_attacks_count_in_equal_parts() -> None:
    alike = np.zeros((2, 1, 1, 10))
    alike[0, 0, 0, 9] = 1.0
    alike[1, 0, 0, 8] = 1.0
    weights = strongest_of(alike)
    assert weights.sum(0) == pytest.approx(1.0)
    assert under(weights, alike).mean() == under(strongest_of(alike[::-1]), alike[::-1]).mean()


def test_of_equal_attacks_in_a_cell_the_one_that_is_stronger_elsewhere_counts() -> None:
    values = np.zeros((2, 1, 2, 10))
    values[1, 0, 1] = 0.5
    assert (strongest_of(values)[0] == 1).all()
