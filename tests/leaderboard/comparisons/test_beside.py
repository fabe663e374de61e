"""One's own rows beside published ones: in the same threat model, on the same scenarios, and marked."""

from __future__ import annotations

import io
from collections.abc import Sequence

import jsonschema
import pyarrow as pa
import pytest
from rich.console import Console

from cavbench.documents import document as enveloped
from cavbench.documents import schema
from cavbench.errors import UserError
from cavbench.leaderboard.page.document import document
from cavbench.leaderboard.ranking.boards import Board, read_boards
from cavbench.leaderboard.terminal.ranking import print_boards
from cavbench.scenarios import Cell
from tests.leaderboard.synthetic import CLEAR, drive

COMMON = {"episodes": 6, "runs": (0,)}


def records(
    *attacks: str,
    skill: float,
    access: str = "scores",
    cells: Sequence[Cell] = CLEAR,
    budget: float = 0.1,
    defense: str = "none",
) -> pa.Table:
    tables = [drive(skill=0.8, cells=cells, defense=defense, **COMMON)]  # type: ignore[arg-type]
    for attack in attacks:
        where = {"cells": cells, "threat": ("relative", budget), "defense": defense}
        made = drive(attack=attack, skill=skill, queries=5.0, **where, **COMMON)  # type: ignore[arg-type]
        place = made.schema.get_field_index("threat_access")
        tables.append(made.set_column(place, made.schema.field(place), pa.array([access] * made.num_rows)))
    return pa.concat_tables(tables)


def beside(own: pa.Table, published: pa.Table) -> list[Board]:
    return read_boards({"driving": own}, {"driving": published})[0]


def test_the_same_victim_has_two_rows_of_which_ones_own_is_marked() -> None:
    own, theirs = (records("zo", skill=skill) for skill in (0.6, 0.2))
    (board,) = beside(own, theirs)
    scores = {row.mine: row.worst.score.estimate for row in board.rows}
    assert scores[True] > scores[False] + 0.2
    console = Console(width=120, file=io.StringIO())
    print_boards([board], console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert text.count("▸") == 2, "the row, and what the mark means"


def test_published_rows_are_of_the_scenarios_that_ones_own_have() -> None:
    own = records("zo", skill=0.6, cells=CLEAR[:2])
    theirs = records("zo", skill=0.2, defense="sa")
    (board,) = beside(own, theirs)
    assert [row.worst.cells for row in board.rows] == [tuple(CLEAR[:2])] * 2


def test_a_published_attack_counts_under_less_access_if_it_asks_for_no_more() -> None:
    own = records("pgd", access="gradients", skill=0.6)
    theirs = records("pgd", "plan", access="dynamics", skill=0.2, defense="sa")
    (board,) = beside(own, theirs)
    row = next(row for row in board.rows if not row.mine)
    assert {one.identity["attack"] for one in row.attacks} == {"pgd"}, "plan needs to know the dynamics"


def test_another_budget_is_not_comparable_which_is_said() -> None:
    own = records("zo", budget=0.2, skill=0.6)
    (board,) = beside(own, records("zo", skill=0.2))
    assert all(row.mine for row in board.rows)
    console = Console(width=120, file=io.StringIO())
    print_boards([board], console)
    assert "no published row was driven in this threat model" in console.file.getvalue()  # type: ignore[attr-defined]


def test_without_an_attack_there_is_nothing_to_rank() -> None:
    with pytest.raises(UserError, match="nothing was attacked"):
        beside(records(skill=0.6), records("zo", access="dynamics", skill=0.2))


def test_the_document_says_whose_a_row_is() -> None:
    own, theirs = (records("zo", skill=skill) for skill in (0.6, 0.2))
    boards, comparisons = read_boards({"driving": own}, {"driving": theirs})
    made = enveloped("beside", document(boards, comparisons, None))
    jsonschema.validate(made, schema())
    assert sorted(row["mine"] for row in made["boards"][0]["rows"]) == [False, True]
    pairs = {pair["key"]: pair["mine"] for pair in made["pairs"]}
    for row in made["boards"][0]["rows"]:
        assert {pairs[key] for key in row["pairs"]} == {row["mine"]}
