"""A browser, and the page of a results folder with something of everything."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console

from cavbench.leaderboard.page.write import write as write_page
from tests.leaderboard.full_house import write as write_records


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `leaderboard.html`, and its results in `results`."""
    folder = tmp_path_factory.mktemp("site")
    out = write_records(folder / "results")
    with (folder / "terminal.txt").open("w") as file:
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
