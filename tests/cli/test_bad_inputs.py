"""Whatever is typed: one line of ours, a code other than 0, and nothing of the libraries' words."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.command import Said
from tests.soak.bad_inputs import bad_inputs

PROSE = re.compile(
    r"Traceback|hydra|omegaconf|torch\._|torch\.serialization|LLVM|enforce fail|\[ONNXRuntimeError\]|Error:|mismatched input"
    r"|of type '\w+'|could not be converted|no viable|token recognition"
)


@pytest.mark.slow
def test_bad_inputs_get_one_line(bench: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    (tmp_path / "files").mkdir()
    for words in bad_inputs(60, seed=0, folder=tmp_path / "files"):
        said = bench(*words)
        shown = [word[:80] for word in words]
        assert said.code != 0, shown
        assert said.out == "", shown
        assert len(said.err.strip().splitlines()) == 1, (shown, said.err)
        assert said.err.startswith("error: "), (shown, said.err)
        assert not PROSE.search(said.err), (shown, said.err)
        assert len(said.err) < 400 or "known: " in said.err, (shown, said.err)
        assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e]", said.err), (shown, said.err)
