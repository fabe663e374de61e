"""What docs/plugins.md tells a plug-in's author to type is typed, line by line."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import pytest

from bench.records import store as results
from tests.framework.conftest import BENCH
from tests.framework.distributions import pip_install

PAGE = Path(__file__).parents[2] / "docs" / "plugins.md"
SMALLER = ("seeds=0", "reference=false", "record=0", "world.max_steps=30")
"""What makes a run of the page quick, beside what it says."""


@pytest.mark.slow
def test_the_way_to_a_scored_row_is_as_the_page_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    site, package = tmp_path / "site", tmp_path / "cavbench-my-attack"
    # What `pip install -e` does, but beside the environment of the tests: the package's own files are found first.
    monkeypatch.setenv("PYTHONPATH", f"{package}:{site}")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    for language, block in re.findall(r"```(\w+)\n(.*?)```", PAGE.read_text(), re.DOTALL):
        if language == "python":
            (package / "cavbench_my_attack.py").write_text(block)
            continue
        for line in block.splitlines():
            program, *words = shlex.split(line)
            if program == "pip":
                assert words == ["install", "-e", "cavbench-my-attack[test]"]
                pip_install(site, package)
                continue
            assert program == "bench"
            command = [*BENCH, *words, *(SMALLER if words[0] == "run" else ())]
            ended = subprocess.run(command, capture_output=True, text=True, check=False)
            assert ended.returncode == 0, f"{line}: {ended.stdout}{ended.stderr}"
    rows = [row for row in results.read(tmp_path / "results").to_pylist() if row["attack"] == "my_attack"]
    first, own = ([row for row in rows if (row["queries"] > 0) == asks] for asks in (True, False))
    assert len(first) == len(own) == 20
    assert {row["attack_shipped_by"] for row in rows} == {"cavbench-my-attack 0.1.0"}
