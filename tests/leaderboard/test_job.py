"""`make publish`: what the leaderboard lacks is named with its cost, driven, and published when it is whole."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest

from cavbench.leaderboard.job import Wanted, main, wanted_rows
from cavbench.leaderboard.published import HOME

SMALL = ("victim=dqn", "lanes=3", "density=1", "weather=clear", "episodes=2", "seeds=0", "reference=false", "workers=1")


def test_a_row_is_trained_driven_and_published_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    words = ["victim.decisions=64", "victim.hidden=8", *SMALL]
    (tmp_path / "board.toml").write_text(f"[[row]]\nwords = {words}\n")
    (row,) = wanted_rows(tmp_path, tmp_path / "results")
    assert row.missing == "all"
    assert (row.trainings.seeds, row.trainings.cpu_s) == ((0,), 0.0)
    assert row.drive()
    (again,) = wanted_rows(tmp_path, tmp_path / "results")
    assert again.missing == ""
    assert again.trainings.seeds == ()
    assert again.face["scenarios"] == 2
    assert len(again.face["attacks"]) == len(row.plan.pairs) > 10
    longer = Wanted((*words[:-4], "episodes=3", "seeds=0,1"), tmp_path, tmp_path / "results")
    assert longer.missing == "1 of 2 trainings, 2 of 3 scenarios"
    assert longer.trainings.seeds == (1,)
    assert longer.cpu_s > longer.plan.cost.cpu_s


def test_a_row_that_cannot_be_driven_is_not_published(tmp_path: Path) -> None:
    row = Wanted((*SMALL, "unit_timeout=0.000001"), tmp_path, tmp_path / "results")
    assert not row.drive()
    assert not (tmp_path / "rows").exists()


def test_what_is_missing_is_said_with_its_cost(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--list"]) == 0
    said = capsys.readouterr().out
    home = Path(str(files(HOME)))
    rows = wanted_rows(home, Path("results/board"))
    for row in rows:
        assert (f" {row.name} " in said) == bool(row.missing)
    assert said.splitlines()[-1].startswith(" all ")


def test_every_row_of_driving_that_is_published_is_in_the_list() -> None:
    home = Path(str(files(HOME)))
    listed = {row.name for row in wanted_rows(home, Path("results/board"))}
    assert listed == {path.stem for path in (home / "rows" / "standard-v2").glob("*.json")}


def test_what_has_no_training_of_its_own_is_not_trained(tmp_path: Path) -> None:
    planner, shield = (
        Wanted(words, tmp_path, tmp_path) for words in (("victim=planner", *SMALL[1:]), (*SMALL, "defense=shield"))
    )
    assert planner.trainings.seeds == ()
    assert shield.trainings == Wanted(SMALL, tmp_path, tmp_path).trainings
