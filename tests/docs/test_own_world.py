"""The commands of docs/worlds/your_own.md work from top to bottom."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from cavbench.core.track import track
from cavbench.records import reading
from tests.command import forked
from tests.plugins.distributions import pip_install
from tests.tree import ROOT

PAGE = ROOT / "docs" / "worlds" / "your_own.md"
SMALLER = ("seeds=0", "record=0", "world.max_steps=15", "executor=serial")
"""Options added to the runs of the page, to make them quick."""


@pytest.mark.slow
def test_the_commands_of_the_page_work_from_top_to_bottom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    site, package = tmp_path / "site", tmp_path / "cavbench-my-world"
    (block,) = re.findall(r"```sh\n(.*?)```", PAGE.read_text(), re.DOTALL)
    for line in block.splitlines():
        program, *words = shlex.split(line)
        if program == "pip":
            pip_install(site, package)
            continue
        more = SMALLER if words[0] == "run" else ()
        said = forked((site,), *words, *more)
        assert said.code == 0, f"{line}: {said.err}"
        if words[0] == "check":
            assert "0 to fix" in said.out
    rows = reading.read(tmp_path / "results", track=track("driving")).to_pylist()
    attacked = [row for row in rows if row["attack"] == "pgd"]
    assert len(attacked) == 40, "two cells of 20 episodes"
    assert {row["world"] for row in rows} == {"my_world"}
    assert {row["world_shipped_by"] for row in attacked} == {"cavbench-my-world 0.1.0"}
