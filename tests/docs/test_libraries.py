"""Every example of docs/libraries.md runs as it is printed, and what it writes is driven."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from cavbench.core.pair import choose
from tests.driving.victims.policy_files import FACTS
from tests.tree import ROOT

EXAMPLES = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "libraries.md").read_text(), re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("place", range(len(EXAMPLES)))
def test_an_example_runs_and_its_file_is_read(place: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / f"example_{place}.py").write_text(EXAMPLES[place])
    importlib.import_module(f"example_{place}")
    for path in tmp_path.glob("*.pt2"):
        choose("victim", "torch", path=str(path)).component.load(0, FACTS)
