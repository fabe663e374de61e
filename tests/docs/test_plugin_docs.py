"""All code of docs/plugins.md is written to the named files, checked and run, in the order of the page."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest

from cavbench.core.track import track
from cavbench.records import reading
from tests.command import forked
from tests.plugins.distributions import pip_install
from tests.tree import ROOT

PAGE = ROOT / "docs" / "plugins.md"
SMALLER = ("seeds=0", "reference=false", "record=0", "world.max_steps=15", "executor=serial")
"""Options added to the runs of the page, to make them quick."""
TABLES = re.compile(r"# What makes it a plug-in.*?(?=\n\[tool\.pytest)", re.DOTALL)
"""Matches the entry points and modules in the pyproject.toml that `bench new` writes."""


def blocks() -> list[tuple[str, str, str]]:
    """Language and content of each code block of the page, and the file named last before it."""
    text = PAGE.read_text()
    found = []
    for match in re.finditer(r"```(\w+)\n(.*?)```", text, re.DOTALL):
        named = re.findall(r"`(\w+\.(?:py|toml))`", text[: match.start()])
        found.append((match[1], match[2], named[-1] if named else ""))
    return found


@pytest.mark.slow
def test_the_commands_of_the_page_work_from_top_to_bottom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    site, package = tmp_path / "site", tmp_path / "cavbench-my-attack"
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    for language, block, file in blocks():
        match language:
            case "python":
                (package / file).write_text(block)
            case "toml":
                written = (package / "pyproject.toml").read_text()
                assert TABLES.search(written)
                (package / "pyproject.toml").write_text(TABLES.sub(lambda _, block=block: block, written))
            case "sh":
                for line in block.splitlines():
                    typed(line, package, site)
    rows = reading.read(tmp_path / "results", track=track("driving")).to_pylist()
    searched = [row for row in rows if row["attack"] == "my_attack" and row["queries"] > 0]
    own = [row for row in rows if (row["attack"], row["defense"], row["queries"]) == ("my_attack", "none", 0)]
    assert len(searched) == len(own) == 20
    assert {row["attack_shipped_by"] for row in own} == {"cavbench-my-attack 0.1.0"}
    stacked = [row for row in rows if (row["attack"], row["defense"]) == ("held_offset", "frame_mean")]
    assert len(stacked) == 20
    learned = [row for row in rows if row["attack"] == "universal"]
    assert len(learned) == 20
    followed = [row for row in rows if row["world"] == "car_following" and row["attack"] == "noise"]
    assert {json.dumps(json.loads(row["cell"])) for row in followed} == {
        '{"gap": 20.0, "braking": 2.0}',
        '{"gap": 20.0, "braking": 4.0}',
    }
    assert {row["defense"] for row in followed} == {"none", "rounding"}


def typed(line: str, package: Path, site: Path) -> None:
    """Run a command of the page."""
    program, *words = shlex.split(line)
    if program == "pip":
        assert words == ["install", "-e", "cavbench-my-attack[test]"]
        pip_install(site, package)
        return
    assert program == "bench"
    # The effect of `pip install -e`, beside the environment of the tests: the package's own files are found first.
    said = forked((package, site), *words, *(SMALLER if words[0] == "run" else ()))
    assert said.code == 0, f"{line}: {said.out}{said.err}"
