"""Attacks that learn, on the command line: trained into the zoo, loaded by a run, replayed from a record."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavbench.core.track import track
from cavbench.records import reading
from cavbench.run.replay import replay
from tests.cli.test_cli import assert_one_line
from tests.command import Bench

SHORT = ("attack=paad", "attack.decisions=8", "attack.hidden=8", "attack.training_steps=1", "victim=dqn")
RUN = (
    "lanes=3",
    "density=1",
    "weather=clear",
    "episodes=2",
    "record=0",
    "reference=false",
    "executor=serial",
    "seeds=0",
)


@pytest.mark.slow
def test_an_attack_is_trained_then_run_then_replayed(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    run = ("run", *SHORT, *RUN, "world.max_steps=20", f"out={tmp_path / 'results'}")
    missing = bench(*run)
    options = "attack.decisions=8 attack.hidden=8 attack.training_steps=1"
    assert_one_line(missing, "the zoo has no 'paad-dqn' with", f"victim=dqn attack=paad {options} seeds=0`")
    said = bench("train", *SHORT, "seeds=0")
    assert said.code == 0
    assert f"To use it: bench run victim=dqn attack=paad {options}" in said.out
    assert bench(*run).code == 0
    records = reading.read(tmp_path / "results", track=track("driving"))
    attacked = [row for row in records.to_pylist() if row["attack"] == "paad"]
    assert len(attacked) == 2
    assert {row["queries"] for row in attacked} == {91.0}
    again = replay(tmp_path / "results", attacked[0])
    assert (again.changed, again.differences) == ("", ())
    bench("train", *SHORT, "seeds=0", "world.vehicles=5")
    assert len(list((tmp_path / "zoo").glob("paad-dqn-*/seed0.safetensors"))) == 2


def test_what_cannot_be_trained_is_refused_in_one_line(bench: Bench) -> None:
    assert_one_line(bench("train", "attack=noise", "victim=dqn"), "nothing to train: attack 'noise' does not learn")
    assert_one_line(bench("train", "attack=paad", "victim=blind"), "does not fit victim 'blind'", "ignores its input")
    assert_one_line(bench("train", "attack=paad,sarsa"), "not 2: give one attack")
    assert_one_line(bench("train", "attack=paad", "threat.budget=0.2"), "unknown key 'threat.budget'")
    assert_one_line(
        bench("train", "attack=paad", "attack.trained_in=thesis"), "attack.trained_in=thesis is not the world"
    )
