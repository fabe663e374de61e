"""The job of the leaderboard over worlds: what it drives is what the leaderboard needs, and it publishes it."""

from __future__ import annotations

from importlib.resources import files
from itertools import groupby
from pathlib import Path

import pytest

from cavbench.leaderboard import worlds_job
from cavbench.leaderboard.published import HOME
from cavbench.leaderboard.worlds_job import main, runs

TABLE = Path(str(files(HOME))) / "worlds.toml"


def test_every_row_is_driven_in_each_of_its_worlds_and_each_world_has_its_reference() -> None:
    found = runs(TABLE)
    worlds = {words[0] for words in found}
    assert len(worlds) == 8
    for world in worlds:
        own = [words for words in found if words[0] == world]
        assert sum("attack=none" in words and "victim=clairvoyant" in words for words in own) == 1
        assert all(("attack=worlds" in words) != ("attack=none" in words) for words in own)
        assert sum(word == "victim=planner" for words in own for word in words) == (
            world in ("world=highway", "world=merge", "world=exit")
        )


def test_a_row_is_whole_before_the_next_one_begins() -> None:
    rows = [
        " ".join(word for word in words if word.split("=")[0].startswith(("victim", "defense")))
        for words in runs(TABLE)
    ]
    rows = [row.partition(" victim.trained_in=")[0] for row in rows]
    assert [one for one, _ in groupby(rows)] == list(dict.fromkeys(rows))


def test_a_driver_that_was_trained_in_each_world_is_the_one_of_the_world_that_it_drives_in() -> None:
    homes = {
        words[0].removeprefix("world="): [word for word in words if word.startswith("victim.trained_in=")]
        for words in runs(TABLE)
        if "victim.decisions=12000" in words
    }
    assert len(homes) == 8
    assert homes.pop("highway") == []
    assert homes == {world: [f"victim.trained_in={world}"] for world in homes}


def test_what_a_run_costs_is_said(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    some = runs(TABLE)[:2] + runs(TABLE)[-1:]
    monkeypatch.setattr(worlds_job, "runs", lambda table: some)
    assert main(["--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) >= 2 + len(some)
    assert lines[-1].startswith(" all ")


def test_what_was_driven_is_published(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "worlds.toml").write_text(
        'words = ["attack=noise", "victim=dqn", "weather=clear", "episodes=1", "seeds=0", "reference=false"]\n'
        '[world.highway]\nwords = ["lanes=3", "density=1"]\n[[row]]\nwords = ["world.max_steps=5"]\n'
    )
    monkeypatch.setattr(worlds_job, "files", lambda name: tmp_path)
    assert main(["--hours", "1", "--out", str(tmp_path / "results")]) == 0
    assert [path.stem for path in (tmp_path / "data" / "worlds-2").iterdir()] == ["dqn"]
