"""The command and the call of README.md print what stands there."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.command import Said
from tests.tree import ROOT

PAGE = ROOT / "README.md"


@pytest.mark.slow
def test_the_readme_shows_what_its_command_and_its_call_print(
    bench: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    (console, code, printed) = (_block(language) for language in ("console", "python", "text"))
    command, *table = console.splitlines()
    said = bench(*shlex.split(command)[2:], "executor=serial")
    assert said.code == 0
    assert "\n".join(table) in "\n".join(line.rstrip() for line in said.out.splitlines())
    exec(compile(code, PAGE, "exec"), {})
    assert [line.rstrip() for line in capsys.readouterr().out.splitlines()] == printed.splitlines()


def _block(language: str) -> str:
    """The only code block of a language."""
    (found,) = re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), re.DOTALL)
    return str(found)
