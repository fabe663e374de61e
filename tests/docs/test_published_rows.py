"""The table of docs/limits.md says what the published records hold."""

from __future__ import annotations

import re
import sys

import duckdb
import pytest

from cavbench.leaderboard.published import every_track
from cavbench.leaderboard.ranking.boards import Board, read_boards
from tests.tree import ROOT

README = {
    "driver `dqn`": ("dqn", "none"),
    "`dqn`, adversarially trained": ("dqn", "advtrain"),
    "`dqn`, trained behind a tracker and a shield": ("dqn", "tracker+shield"),
    "`planner`: rules instead of a network": ("planner", "none"),
    "detector `yolov5`": ("yolov5", "none"),
    "`yolov3_tiny`, adversarially trained": ("yolov3_tiny", "advtrain_detection"),
}
"""The rows of README.md: victim and defence."""
GRIDS = ("standard-v2", "approach-v1")


@pytest.fixture(scope="module")
def boards() -> list[Board]:
    return read_boards(every_track())[0]


@pytest.fixture(scope="module")
def table(boards: list[Board]) -> str:
    sys.path.insert(0, str(ROOT / "docs" / "_ext"))
    from published_rows import tables

    return tables(boards)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("victim", "defense", "row"), [("dqn", "car", "dqn + car"), ("sac", "none", "sac"), ("dqn", "none", "dqn")]
)
def test_a_row_has_the_seeds_scenarios_and_attacks_of_its_records(
    table: str, victim: str, defense: str, row: str
) -> None:
    records = every_track()["driving"]
    driven = f"""
        from records where victim = '{victim}' and defense = '{defense}' and attack <> 'none' and grid = 'standard-v2'
        and not contains(victim_params, 'tracker')
    """
    seeds, cells, scenarios = duckdb.sql(
        f"select count(distinct training_seed), count(distinct cell), count(distinct seed) {driven}"
    ).fetchall()[0]
    attacks = duckdb.sql(f"select distinct attack, attack_params {driven}").fetchall()
    assert len(records)
    found = next(line for line in table.splitlines() if line.startswith(f"| {row} |"))
    assert [cell.strip() for cell in found.split("|")[2:4]] == [str(seeds), f"{cells} x {scenarios}"]
    number, _, names = found.split("|")[4].partition(":")
    assert int(number) == len(attacks)
    assert set(names.replace(",", "").split()) == {name for name, _ in attacks}


@pytest.mark.slow
def test_the_page_has_every_row_of_the_leaderboards(table: str, boards: list[Board]) -> None:
    assert table.count("\n| ") - len(boards) == sum(len(board.rows) for board in boards)
    assert "| none |" in next(line for line in table.splitlines() if line.startswith("| planner |")), (
        "it has no training seed"
    )


@pytest.mark.slow
def test_the_readme_has_the_scores_of_the_leaderboard(boards: list[Board]) -> None:
    written = {}
    for line in re.findall(r"^\| (.*`.*) \|$", (ROOT / "README.md").read_text(), re.M):
        name, *shown = line.split(" | ")
        written[README[name.removesuffix(" *")]] = (name.endswith(" *"), *shown)
    published = {}
    for row in (row for board in boards if board.grid in GRIDS for row in board.rows):
        worst, defended = row.worst, (str(row.identity["victim"]), str(row.identity["defense"]))
        assert worst.clean
        assert worst.failure
        rates = (
            f"{worst.clean.estimate:.2f}",
            f"{worst.score.estimate:.2f}",
            f"{worst.failure.estimate:.0%}".replace("%", " %"),
        )
        published[defended] = (row.flagged, *rates)
    assert written == {defended: published[defended] for defended in README.values()}
