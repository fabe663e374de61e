"""The leaderboard in the repository is what today's code makes of the records in the repository."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from rich.console import Console

import leaderboard
from leaderboard.page.write import write

MADE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d\+00:00)?")
NUMBER = re.compile(r"-?\d+\.\d+(?:e-?\d+)?")


@pytest.fixture(scope="module")
def remade(tmp_path_factory: pytest.TempPathFactory) -> Path:
    page = tmp_path_factory.mktemp("remade") / "index.html"
    write(None, page, Console(quiet=True))
    return page


@pytest.mark.parametrize("ending", ["html", "json", "csv"])
def test_the_published_leaderboard_is_up_to_date(ending: str, remade: Path) -> None:
    published, now = (
        MADE.sub("", folder.joinpath(f"index.{ending}").read_text())
        for folder in (Path(leaderboard.__file__).parent, remade.parent)
    )
    remake = "bench report html=leaderboard/index.html makes it anew"
    assert NUMBER.split(now) == NUMBER.split(published), remake
    numbers = [[float(number) for number in NUMBER.findall(text)] for text in (now, published)]
    assert numbers[0] == pytest.approx(numbers[1], abs=2e-3), remake
