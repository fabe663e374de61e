"""`bench report`: prints a report on a results folder, or writes its leaderboards as an HTML page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from cavbench.cli.words import split
from cavbench.core import registry
from cavbench.records import reading

PAGES = "cavbench.pages"
KEYS = ("out", "html")


def print_report(words: Sequence[str], console: Console) -> None:
    """Print a report, or write a page.

    Args:
        words: options: the name of a report (default `run`), `out=FOLDER` and `html=PAGE`.
        console: console to print to.

    Raises:
        UserError: if an option is unknown, or there are no records.
    """
    names, values = split(words, KEYS, names=1)
    out = Path(values.get("out", "results")).expanduser()
    name = names[0] if names else "leaderboard" if "html" in values else "run"
    published = "out" not in values and not out.exists() and name != "run"
    source = "published records (there is no folder results)" if published else f"records of the folder {out}"
    if "html" in values:
        page = registry.resolve(PAGES, name, "page")
        page(None if published else out, Path(values["html"]).expanduser(), console)
        console.print(source)
        return
    function = registry.resolve(registry.REPORTS, name, "report")
    records = {} if published else reading.read_all(out)
    if "out" not in values:
        console.print(source)
    function(records, console)
