"""The prose check of the documentation finds what it should, and nothing else."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from docs.prose import ROOT, UNDONE, check, findings

LONG = "Two" + 30 * " two"
FITS = "Two" + 29 * " two"


@pytest.mark.parametrize(
    ("page", "line", "complaint"),
    [
        (f"# Title\n\n{FITS}.\n{LONG}.", 4, "a sentence of 31 words"),
        (f"Short.\n\n- an item\n- {LONG}", 4, "a sentence of 31 words"),
        (f"One two.\nThree `code of.\n  words` and\n{LONG}.", 2, "a sentence of 34 words"),
        (f"| a | b |\n|---|---|\n| 1 | {'x' * 121} |", 3, "a cell of 121 characters"),
        ("It scores 0.64 and\n.28 under attack.", 2, ".28, not 0.28"),
        ("| score |\n|---|\n| .5 |", 3, ".5, not 0.5"),
        ("Short.\n" + "x" * 151, 2, "a line of 151 characters"),
        ("```\n" + "x" * 151 + "\n```", 2, "a line of 151 characters"),
    ],
)
def test_what_breaks_a_rule_is_found_at_its_line(page: str, line: int, complaint: str) -> None:
    ((found, what),) = findings(page)
    assert found == line
    assert complaint in what


@pytest.mark.parametrize(
    "page",
    [
        f"{FITS}.\n{FITS}!\n{FITS}?",
        f"- {FITS}\n- {FITS}",
        f"The paper of Madry et al. 2018 ({' '.join(['word'] * 22)}).",
        f"`{LONG}`\nand $a = .5 {LONG[:60]}$, version 1.12.1, a file `.28`, section 4.3.",
        f"```\n{LONG[:140]}\n{LONG[:140]}\n.64\n```",
        f"| a |\n|---|\n| [{'x' * 100}](https://example.org/{'y' * 100}) |",
        f"$$ {'x' * 150} $$",
        f"Read [the page](https://example.org/{'y' * 150}).",
    ],
)
def test_what_keeps_the_rules_is_not_found(page: str) -> None:
    assert list(findings(page)) == []


def test_an_abbreviation_ends_no_sentence() -> None:
    half = "Two" + 14 * " two"
    assert [what[:22] for _, what in findings(f"{half} et al. {half}.")] == ["a sentence of 32 words"]


def test_a_page_that_keeps_the_rules_leaves_the_list(tmp_path: Path) -> None:
    (tmp_path / "docs" / "attacks").mkdir(parents=True)
    (tmp_path / "README.md").write_text(LONG)
    (tmp_path / "CONTRIBUTING.md").write_text(FITS)
    (tmp_path / "docs" / "attacks" / "zo.md").write_text(LONG)
    assert [complaint.split(": ")[0] for complaint in check(tmp_path, undone=())] == [
        "README.md:1",
        "docs/attacks/zo.md:1",
    ]
    assert check(tmp_path, undone=("README.md", "docs/attacks")) == []
    assert check(tmp_path, undone=("README.md", "CONTRIBUTING.md", "docs/attacks")) == [
        "docs/prose.py: CONTRIBUTING.md keeps the rules: take it from UNDONE"
    ]


def test_the_documentation_keeps_the_rules() -> None:
    assert check(ROOT, UNDONE) == []


def test_the_command_fails_for_a_page_that_breaks_a_rule(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"{FITS}.")
    command = [sys.executable, str(ROOT / "docs" / "prose.py"), str(page)]
    assert subprocess.run(command, check=False).returncode == 0
    page.write_text(f"{LONG}.")
    failed = subprocess.run(command, check=False, capture_output=True, text=True)
    assert failed.returncode == 1
    assert f"{page}:1: a sentence of 31 words, at most 30" in failed.stdout
