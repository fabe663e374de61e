"""Defences that do not defend are flagged after a real run, and rank below the others."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from cavbench.core import registry
from cavbench.core.track import track
from cavbench.leaderboard.comparisons.reading import measurements
from cavbench.leaderboard.ranking.boards import Row, read_boards
from cavbench.records import reading
from tests.command import Said
from tests.plugins.distributions import install
from tests.tree import PLUGINS

BAD = ("deaf", "stepped", "detached")
WORDS = ("victim=toy", "world=toy", "lanes=3,4", "density=1", "weather=clear", "episodes=20", "seeds=0,1,2", "executor=serial",
         "reference=false", "world.max_steps=30")  # fmt: skip


@pytest.fixture
def rows(plugins: Path, bench: Callable[..., Said], tmp_path: Path) -> dict[str, Row]:
    """The rows of a leaderboard of the bad defences and of `none`, by defence."""
    code = (PLUGINS / "bad_defenses.py").read_text()
    names = (*BAD, "dicing", "hiding")
    points = {"cavbench.defenses": {name: f"bad_defenses_plugin:{name.capitalize()}" for name in names}}
    install(plugins, "cavbench-bad", points, {"bad_defenses_plugin": code})
    registry.installed.cache_clear()
    out = tmp_path / "results"
    said = bench("run", "attack=pgd,zo,noise", f"defense=none,{','.join(names)}", *WORDS, f"out={out}")
    # The run sees the noise of the process' generators only; a defence that hides its noise is refused, the others are driven.
    assert said.code == 2, said.err
    assert "hiding + toy, seed 0 is refused: it answers otherwise when it is asked the same again" in said.err
    (board,) = read_boards(reading.read_all(out, measurements(track("driving"))))[0]
    return {str(row.identity["defense"]): row for row in board.rows}


def fired(row: Row) -> set[str]:
    return {flag.name for flag in row.flags if flag.fired}


def test_bad_defences_are_flagged_and_a_sound_victim_is_not(rows: dict[str, Row]) -> None:
    found_out = {"ignores_input", "zero_gradients", "one_draw"}
    assert not fired(rows["none"]) & (found_out | {"unattacked"})
    assert fired(rows["deaf"]) & found_out >= {"ignores_input"}
    assert fired(rows["stepped"]) & found_out == {"zero_gradients"}
    assert fired(rows["detached"]) & found_out == {"zero_gradients"}
    # Every attack asks a random victim several times.
    assert not fired(rows["dicing"]) & found_out
    assert all(rows[name].flagged for name in BAD)
