"""`device=`: a victim on another device has the same records, whatever its defence; a GPU that is not there is one line."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from cavbench.core import device
from cavbench.errors import UserError
from cavbench.run.config import plan_of
from tests.command import Said
from tests.plugins import other_device
from tests.tree import ROOT

SMALL = ("attack=noise", "lanes=3", "density=1", "weather=clear", "seeds=0", "reference=false")
without_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")


@pytest.mark.slow
@pytest.mark.parametrize("case", other_device.CASES)
def test_a_victim_on_another_device_has_the_measurements_of_the_processor(case: str) -> None:
    root = ROOT
    command = [sys.executable, "-m", other_device.__name__, case]
    done = subprocess.run(
        command, cwd=root, env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{case}: the same on {other_device.NAME}\n"


@without_gpu
def test_a_gpu_that_is_not_there_is_refused_before_any_work(bench: Callable[..., Said], tmp_path: Path) -> None:
    said = bench("run", *SMALL, "device=cuda", f"out={tmp_path / 'out'}")
    assert said.code == 2
    assert "device=cuda needs a GPU that torch can use, and there is none" in said.err.splitlines()[-1]
    assert not (tmp_path / "out").exists()


@without_gpu
def test_auto_without_a_gpu_is_the_processor_and_the_same_unit() -> None:
    assert plan_of([*SMALL, "device=auto"]).units() == plan_of([*SMALL]).units()


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("device=gpu",), "unknown device 'gpu'"),
        (("device=cuda", "executor=ray"), "executor=ray gives its workers no GPU"),
    ],
)
def test_devices_that_cannot_be_are_refused(words: tuple[str, ...], why: str) -> None:
    with pytest.raises(UserError, match=why):
        plan_of([*SMALL, *words])


def test_records_of_a_gpu_say_so_and_are_units_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    here = plan_of([*SMALL]).units()[0]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "GPU 7")
    there = plan_of([*SMALL, "device=auto"]).units()[0]
    assert there.job.device == "cuda"
    assert there.fingerprint != here.fingerprint
    machine = str(there.constants(1.0)["machine"])
    assert "; victim on cuda: GPU 7" in machine
    assert device.recorded(machine) == "cuda"
    assert device.recorded(str(here.constants(1.0)["machine"])) == "cpu"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert device.recorded(machine) == "cpu"
