"""The page of the published records, built anew, and the face of each row, which is in the repository."""

from __future__ import annotations

import json
import re
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from cavbench.leaderboard.faces import face
from cavbench.leaderboard.published import row_files
from cavbench.leaderboard.terminal.ranking import leaderboard_report
from tests.tree import ROOT

HOME = ROOT / "leaderboard"


def test_the_films_of_the_published_rows_lie_beside_the_page(published_site: Path) -> None:
    made = json.loads((published_site / "index.json").read_text())
    clips = {row["clip"] for board in made["boards"] for row in board["rows"] if row["clip"]}
    assert len(clips) >= 4
    for clip in clips:
        assert 10_000 < (published_site / clip).stat().st_size < 300_000


def test_without_records_the_leaderboard_on_the_terminal_is_the_published_one() -> None:
    console = Console(file=StringIO(), width=110)
    leaderboard_report({}, console)
    said = console.file.getvalue()  # type: ignore[attr-defined]
    assert "driving in highway, standard-v2, relative 0.1" in said
    assert re.search(r"1 +shield +dqn", said)


def test_reports_import_no_torch(published_site: Path) -> None:
    """It takes seconds; records say all that a report needs."""
    assert json.loads((published_site / "said.json").read_text()) == ["False\n", ""]


def test_every_row_has_a_face_and_every_face_a_row() -> None:
    names = {path.relative_to(HOME / "data").with_suffix("") for path in row_files(HOME)}
    assert {path.relative_to(HOME / "rows").with_suffix("") for path in (HOME / "rows").glob("*/*")} == names


@pytest.mark.parametrize("file", row_files(HOME), ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_a_face_says_what_the_records_of_its_row_say(file: Path) -> None:
    committed = json.loads((HOME / "rows" / file.parent.name / f"{file.stem}.json").read_text())
    made = face(file)
    assert list(committed) == list(made)
    numbers = [
        [*one.pop("interval"), one.pop("score"), one.pop("clean"), one.pop("failed")] for one in (committed, made)
    ]
    assert committed == made, "python -m cavbench.leaderboard.published writes the faces again"
    assert numbers[0] == pytest.approx(numbers[1], abs=2e-3)


def test_faces_and_the_page_say_the_same(published_site: Path) -> None:
    ranked = json.loads((published_site / "index.json").read_text())["boards"]
    scores = {
        (board["grid"], *(row[kind]["name"] for kind in ("victim", "defense"))): row["values"]["score"]["estimate"]
        for board in reversed(ranked)
        for row in board["rows"]
    }
    faces = [json.loads(path.read_text()) for path in (HOME / "rows").glob("*/*.json")]
    found = {(one["grid"], one["victim"]["name"], one["defense"]["name"]): one["score"] for one in faces}
    assert found == pytest.approx(scores, abs=2e-3)
