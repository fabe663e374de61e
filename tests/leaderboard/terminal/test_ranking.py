"""The ranking on the terminal: names are whole, and sentences are told on request."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable

import pyarrow as pa
import pytest
from rich.console import Console

from cavbench.leaderboard.published import every_track
from cavbench.leaderboard.ranking.boards import Board, read_boards
from cavbench.leaderboard.ranking.worlds import over_several
from cavbench.leaderboard.terminal.ranking import flags_report, leaderboard_report, print_boards
from cavbench.leaderboard.terminal.worlds import print_worlds
from tests.leaderboard.synthetic import CLEAR, approach, drive, probed

LONG = {"behind": "tracker+shield"}


@pytest.fixture(scope="module")
def published() -> dict[str, pa.Table]:
    return every_track()


@pytest.fixture(scope="module")
def boards(published: dict[str, pa.Table]) -> list[Board]:
    """Those of the published records: reading them takes most of the time of a report."""
    return read_boards(published)[0]


def ranking(boards: list[Board], console: Console) -> None:
    """As `leaderboard_report`, of boards that are read already."""
    print_boards(boards, console)
    print_worlds(over_several(boards), console)


def printed(report: Callable[..., None], of: object, width: int) -> str:
    console = Console(file=io.StringIO(), width=width)
    report(of, console)
    return console.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize("width", [80, 100, 140])
def test_no_name_of_the_published_rows_is_broken(boards: list[Board], width: int) -> None:
    text = printed(ranking, boards, width)
    assert max(map(len, text.splitlines())) <= width
    words = set(text.split())
    for board in boards:
        for row in board.rows:
            for kind in ("defense", "victim", "attack"):
                assert str(row.identity[kind]) in words
    assert "behind=tracker+shield" in words


def test_a_ranking_of_seventeen_rows_has_no_sentences_about_each_row(published: dict[str, pa.Table]) -> None:
    text = printed(leaderboard_report, {"driving": published["driving"]}, 100)
    assert "too few seeds" not in text
    assert len(text.splitlines()) < 60
    assert "`bench report flags`" in text


def test_scenarios_at_one_place_do_not_make_an_interval(boards: list[Board]) -> None:
    """All of `crossing` are on one road: fifty times the same frames."""
    rows = [row for board in boards if board.grid == "crossing-v2" for row in board.rows]
    assert rows
    for worst in (row.worst for row in rows):
        assert worst.clean
        assert worst.failure
        assert all(math.isnan(found.low) for found in (worst.score, worst.failure, worst.clean, worst.worst_cell[1]))
        for one in worst.panel.attacks:
            assert math.isnan(one.score.low)
            assert one.clean_score
            assert math.isnan(one.clean_score.low)


def test_a_row_of_one_patch_has_no_rank(published: dict[str, pa.Table], boards: list[Board]) -> None:
    detection = {"detection": published["detection"]}
    rows = [row for board in boards if board.track.name == "detection" for row in board.rows]
    assert {row.one_patch for row in rows} == {True, False}
    assert all((row.group == 0) == (len(row.worst.scores) == 1) for row in rows)
    said = " ".join(printed(leaderboard_report, detection, 120).split())
    assert "rows of one patch without a rank: another patch may take more or less" in said


def test_a_ranking_says_what_the_driven_car_does_where_a_loop_was_closed() -> None:
    clean, attacked = approach(0.9), approach(0.1, attack="eot")
    loop = (
        probed(clean, stopped=True, collided=False, drive_overrun_m=0.0),
        probed(attacked, stopped=False, collided=True, drive_overrun_m=16.0),
    )
    texts = [
        printed(leaderboard_report, {"detection": pa.concat_tables(one)}, 200) for one in ((clean, attacked), loop)
    ]
    assert ["in loop" in text and "collides" in text for text in texts] == [False, True]
    row = next(line for line in texts[1].splitlines() if " none " in line)
    assert row.index("0 %") < row.index("16.0") < row.index("100 %", row.index("16.0"))


def test_why_rows_are_flagged_is_told_on_request() -> None:
    common = {"cells": CLEAR[:3], "episodes": 6, "runs": (0,)}
    records = [
        drive(skill=0.8, **common),  # type: ignore[arg-type]
        drive(attack="zo", skill=0.3, queries=5.0, **common),  # type: ignore[arg-type]
        drive(attack="noise", skill=0.5, **common),  # type: ignore[arg-type]
    ]
    text = " ".join(printed(flags_report, {"driving": pa.concat_tables(records)}, 80).split())
    assert "⚑ too few seeds, scenarios or cells: It was driven with 1 seed" in text
    assert re.search(r"added: zo −0\.\d\d", text)


def test_a_long_name_goes_on_in_the_next_line_at_a_space() -> None:
    names = [drive(victim_params=params, skill=0.8, cells=CLEAR[:3]) for params in ({}, LONG)]
    attacked = [
        drive(attack="zo", victim_params=params, defense="a_defence_with_a_long_name", skill=0.3, cells=CLEAR[:3])
        for params in ({"behind": ""}, LONG)
    ]
    text = printed(leaderboard_report, {"driving": pa.concat_tables([*names, *attacked])}, 80)
    assert "a_defence_with_a_long_name" in text
    assert "behind=tracker+shield" in text
    assert max(map(len, text.splitlines())) <= 80
