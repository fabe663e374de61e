"""A browser, and the page of a results folder with something of everything."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from filelock import FileLock
from rich.console import Console

from cavbench.leaderboard.page.write import write as write_page
from tests.leaderboard.full_house import write as write_records
from tests.leaderboard.synthetic import grid_is_known

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


@pytest.fixture(autouse=True)
def grid() -> Iterator[None]:
    """The grid of made-up records is known."""
    with grid_is_known():
        yield


@pytest.fixture(scope="session")
def published_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the page of the published records, `index.html`: built once, also where several processes test."""
    alone = "PYTEST_XDIST_WORKER" not in os.environ
    folder = (tmp_path_factory.getbasetemp() if alone else tmp_path_factory.getbasetemp().parent) / "published"
    folder.mkdir(exist_ok=True)
    with FileLock(folder / "lock"):
        if not (folder / "said.json").exists():
            (folder / "report.py").write_text(SCRIPT)
            done = subprocess.run(
                [sys.executable, "report.py", "index.html"],
                cwd=folder,
                capture_output=True,
                text=True,
            )
            (folder / "said.json").write_text(json.dumps([done.stdout, done.stderr]))
    return folder


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `leaderboard.html`, and its results in `results`."""
    folder = tmp_path_factory.mktemp("site")
    out = write_records(folder / "results")
    with (folder / "terminal.txt").open("w") as file, grid_is_known():
        write_page(out, folder, Console(file=file, width=120))
    return folder


@pytest.fixture(scope="session")
def browser() -> Iterator[object]:
    """Headless Chromium: the one on the PATH, or the one that `playwright install chromium` fetched."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed: pip install -e '.[dev]'"
    )
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with playwright.sync_playwright() as tool:
        try:
            opened = tool.chromium.launch(executable_path=found, args=["--no-sandbox"])
        except playwright.Error as error:
            pytest.skip(f"no browser (make browser gets one): {str(error).splitlines()[0]}")
        yield opened
        opened.close()
