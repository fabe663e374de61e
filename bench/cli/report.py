"""`bench report`: prints a report on a results folder, or writes it as a page, or as JSON, CSV and LaTeX."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pyarrow as pa
from rich.console import Console
from rich.text import Text

from cavbench import documents
from cavbench.cli import as_json as data
from cavbench.cli.words import split
from cavbench.core import registry
from cavbench.errors import UserError
from cavbench.files import check_folder, whole
from cavbench.records import reading

PAGES = "cavbench.pages"
FILES = ("json", "csv", "latex")
PUBLISHED = ("leaderboard", "worlds", "flags", "thesis")
"""Reports that show published records where there is no results folder."""
KEYS = ("out", "html", *FILES)


def print_report(words: Sequence[str], console: Console, *, as_json: bool = False) -> None:
    """Print a report, or write it to files.

    Args:
        words: options: the name of a report, `out=FOLDER`, `html=PAGE`, and `json=`, `csv=` and `latex=` FILE. The name is
            `run` by default, and `leaderboard` where a file is written.
        console: console to print to.
        as_json: print the report as one document (`cavbench.documents`).

    Raises:
        UserError: if an option is unknown, there are no records, or a file cannot be written.
    """
    names, values = split(words, KEYS, names=1)
    out = Path(values.get("out", "results")).expanduser()
    targets = {key: Path(values[key]).expanduser() for key in FILES if key in values}
    name = names[0] if names else "leaderboard" if "html" in values or targets else "run"
    published = "out" not in values and not out.exists() and name in PUBLISHED
    source = "published records (there is no folder results)" if published else f"records of the folder {out}"
    for key, target in targets.items():
        _check(key, target)
    if "html" in values:
        page = registry.resolve(PAGES, name, "page")
        page(None if published else out, Path(values["html"]).expanduser(), console)
    elif not (targets or as_json):
        _print(name, {} if published else reading.read_all(out), console, "" if "out" in values else source)
        return
    if targets or as_json:
        report = data.report_named(name)
        records = {} if published else reading.read_all(out)
        content = data.results(out, records) if name == "run" else report.content(records, None if published else out)
        _write(report, documents.document(name, content), targets, console, as_json=as_json)
    console.print(Text(source), soft_wrap=True)


def _print(name: str, records: Mapping[str, pa.Table], console: Console, source: str) -> None:
    function = registry.resolve(registry.REPORTS, name, "report")
    if source:
        console.print(Text(source), soft_wrap=True)
    function(records, console)


def _check(key: str, target: Path) -> None:
    check_folder(target.parent, f"the folder of {key}=", key)
    if target.is_dir():
        raise UserError(
            f"{key}={target} is a folder: name a file, for instance {key}={target / 'leaderboard'}.{key[:4]}"
        )


def _write(
    report: documents.Report,
    made: Mapping[str, object],
    targets: Mapping[str, Path],
    console: Console,
    *,
    as_json: bool,
) -> None:
    writers = {"json": documents.written, "csv": report.csv, "latex": report.latex}
    for key, target in targets.items():
        try:
            with whole(target) as file:
                file.write(writers[key](made).encode())
        except OSError as error:
            raise UserError(f"{target} cannot be written: {error.strerror}; choose another with {key}=") from error
        console.print(Text(f" {target} ({target.stat().st_size / 1e6:.2f} MB)"), soft_wrap=True)
    if as_json:
        documents.show(str(made["document"]), made)
