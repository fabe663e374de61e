"""The leaderboard in the repository is what today's code makes of the records in the repository."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from cavbench.leaderboard.terminal.ranking import leaderboard_report
from tests.tree import ROOT

MADE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d\+00:00)?")
NUMBER = re.compile(r"-?\d+\.\d+(?:e-?\d+)?")


SCRIPT = (
    "import sys; from io import StringIO; from pathlib import Path; from rich.console import Console\n"
    "from cavbench.core.track import track; from cavbench.leaderboard.published import published\n"
    "from cavbench.leaderboard.page.write import write; from cavbench.leaderboard.terminal.run import run_report\n"
    "if __name__ == '__main__':\n"
    "    write(None, Path(sys.argv[1]), Console(quiet=True))\n"
    "    records = published(track('detection'))\n"
    "    run_report({'detection': records.slice(0, 54)}, Console(file=StringIO()))\n"
    "    print('torch' in sys.modules)\n"
)
"""Writes the page and a table of a run, and prints whether torch was imported."""


@dataclass(frozen=True)
class Remade:
    """The page that `SCRIPT` wrote in a process of its own, and what it printed."""

    page: Path
    said: tuple[str, str]


@pytest.fixture(scope="module")
def remade(tmp_path_factory: pytest.TempPathFactory) -> Remade:
    folder = tmp_path_factory.mktemp("remade")
    (folder / "report.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, "report.py", "index.html"],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    return Remade(folder / "index.html", (done.stdout, done.stderr))


def test_the_films_of_the_published_rows_lie_beside_the_page(remade: Remade) -> None:
    made = json.loads(remade.page.with_suffix(".json").read_text())
    clips = {row["clip"] for board in made["boards"] for row in board["rows"] if row["clip"]}
    assert len(clips) >= 4
    for clip in clips:
        assert 10_000 < (remade.page.parent / clip).stat().st_size < 300_000


def test_without_records_the_leaderboard_on_the_terminal_is_the_published_one() -> None:
    console = Console(file=StringIO(), width=110)
    leaderboard_report({}, console)
    said = console.file.getvalue()  # type: ignore[attr-defined]
    assert "driving in highway, standard-v1, relative 0.1" in said
    assert re.search(r"1 +advtrain +dqn +0\.\d\d", said)


def test_reports_import_no_torch(remade: Remade) -> None:
    """It takes seconds; records say all that a report needs."""
    assert remade.said == ("False\n", "")


@pytest.mark.parametrize("ending", ["html", "json", "csv"])
def test_the_published_leaderboard_is_up_to_date(ending: str, remade: Remade) -> None:
    published, now = (
        MADE.sub("", folder.joinpath(f"index.{ending}").read_text())
        for folder in (ROOT / "leaderboard", remade.page.parent)
    )
    remake = "bench report html=leaderboard/index.html makes it anew"
    assert NUMBER.split(now) == NUMBER.split(published), remake
    numbers = [[float(number) for number in NUMBER.findall(text)] for text in (now, published)]
    assert numbers[0] == pytest.approx(numbers[1], abs=2e-3), remake
