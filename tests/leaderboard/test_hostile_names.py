"""Records with names that a terminal, a spreadsheet or a browser would obey are shown as plain text."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import pyarrow as pa
import pytest
from rich.text import Text

from cavbench.cli import main as cli
from cavbench.core.track import track
from cavbench.documents import document as enveloped
from cavbench.leaderboard.page.document import document
from cavbench.leaderboard.page.table import table
from cavbench.leaderboard.page.write import html
from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.records import reading, store
from cavbench.terminal import Console
from tests.leaderboard.synthetic import CLEAR, drive

FORMULA, ESCAPE = "=cmd|' /C calc'!A0", "\x1b[2J\x1b]0;owned\x07\u202egnp\x9b31m<script>alert(1)</script>"
OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder in which an attack and a defence have such names."""
    out = tmp_path_factory.mktemp("hostile")
    store.prepare(out)
    columns = {"cells": CLEAR[:1], "runs": (0,), "victim": "dqn", "defense": FORMULA}
    for attack in ("none", ESCAPE):
        records = drive(attack=attack, **columns)  # type: ignore[arg-type]
        units = sorted(set(records["unit"].to_pylist()))
        for unit in units:
            store.write(out, records.filter(pa.compute.equal(records["unit"], unit)))
    return out


@pytest.mark.parametrize("words", [("report",), ("report", "leaderboard"), ("show",)])
def test_the_terminal_shows_plain_text(
    words: tuple[str, ...], hostile: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    monkeypatch.setattr("sys.argv", ["bench", *words, f"out={hostile}"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    said = capsys.readouterr()
    assert not ended.value.code, said.err
    assert "owned" in said.out
    assert not OBEYED.search(said.out + said.err)


def test_colours_of_our_own_are_left() -> None:
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, color_system="standard", highlight=False)
    console.print(Text.assemble(("safe", "red"), " \x1b[31m"))
    assert file.getvalue() == "\x1b[31msafe\x1b[0m ?[31m\n"


def test_the_table_has_no_formula_and_the_page_no_code(hostile: Path) -> None:
    boards, comparisons = read_boards(reading.read_all(hostile))
    made = enveloped("leaderboard", document(boards, comparisons, hostile))
    rows = list(csv.DictReader(io.StringIO(table(made))))
    assert {row["defense"] for row in rows} == {f"'{FORMULA}"}
    assert {row["strongest_attack"][:4] for row in rows} == {"?[2J"}
    assert all(float(row["score"]) >= 0 for row in rows)
    assert not any(OBEYED.search(cell) for row in rows for cell in row.values())
    page = html(made, 1, [], "")
    assert "<script>alert" not in page
    assert track("driving").name in page
