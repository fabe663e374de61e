"""Curves of trainings and scores of runs are written by TorchRL's loggers, and what cannot be written is refused before work."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from cavbench.errors import UserError
from cavbench.run.logs import NEEDS, STEPS, Log, check, log_card
from tests.command import Said


def scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """By name the steps and values that TorchRL's CSV logger wrote."""
    found = {}
    for path in (folder / "scalars").rglob("*.csv"):
        with path.open() as file:
            rows = [(int(step), float(value)) for step, value in csv.reader(file)]
        found[path.relative_to(folder / "scalars").with_suffix("").as_posix()] = rows
    return found


def test_the_numbers_of_a_progress_are_curves_over_the_share_of_the_training(tmp_path: Path) -> None:
    log = Log("csv", tmp_path, "training", {"victim": "dqn"})
    for share, text in ((0.1, ""), (0.5, "safe_progress 0.25"), (1.0, "patch 3, 40%: loss 1.5e-2")):
        log.progress(share, text)
    log_card(log, {"selection_history": [(0.5, 0.25), (1.0, 0.5)], "cpu_seconds": 12.5, "note": "text"})
    log.close()
    found = scalars(tmp_path / "training")
    assert found["safe_progress"] == [(STEPS // 2, 0.25)]
    assert found["loss"] == [(STEPS, 0.015)]
    assert found["patch"] == [(STEPS, 3.0)]
    assert found["checkpoint/score"] == [(STEPS // 2, 0.25), (STEPS, 0.5)]
    assert found["cpu_seconds"] == [(STEPS, 12.5)]
    assert [step for step, _ in found["seconds"]] == [100, 500, 1000]


def test_a_kind_that_does_not_exist_or_is_not_installed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="unknown log 'tensorbord'; did you mean 'tensorboard'"):
        check("tensorbord")
    monkeypatch.setitem(NEEDS, "mlflow", "no_such_package")
    with pytest.raises(UserError, match="log=mlflow needs the package no_such_package: pip install"):
        check("mlflow")


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "logs").touch()
    with pytest.raises(UserError, match="log=csv cannot be written to"):
        Log("csv", tmp_path / "logs", "training", {})


def test_a_run_logs_what_it_prints(bench: Callable[..., Said], tmp_path: Path) -> None:
    words = (
        "attack=nudge",
        "victim=toy",
        "world=toy",
        "lanes=3,4",
        "density=1",
        "weather=clear",
        "episodes=4",
        "seeds=0",
    )
    said = bench("run", *words, "executor=serial", f"out={tmp_path}", "log=csv", "--json")
    made = json.loads(said.out)
    for one in made["pairs"]:
        found = scalars(tmp_path / "logs" / one["card"]["pair"])
        assert found["score"] == [(0, one["score"]["estimate"])]
        assert [value for _, value in found["cells/score"]] == [cell["estimate"] for cell in one["cells"]]
    assert bench("run", *words, "log=paper").code == 2


def test_tensorboard_reads_what_is_logged(tmp_path: Path) -> None:
    accumulator = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator", reason="tensorboard is not installed"
    )
    log = Log("tensorboard", tmp_path, "training", {"victim": "dqn"})
    log.progress(0.5, "loss 0.25")
    log.close()
    found = accumulator.EventAccumulator(str(tmp_path / "training"))
    found.Reload()
    assert [(event.step, event.value) for event in found.Scalars("loss")] == [(STEPS // 2, 0.25)]
