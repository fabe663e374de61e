"""Victims from ONNX files decide like the exported policy, and are black boxes."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cavbench.core.pair import choose
from cavbench.errors import UserError
from cavbench.run.config import plan_of
from tests.checks.rules import broken
from tests.driving.victims.policy_files import (
    FACTS,
    driven,
    onnx_file,
)


@pytest.fixture(scope="module")
def onnx(tmp_path_factory: pytest.TempPathFactory) -> str:
    return onnx_file(tmp_path_factory.mktemp("onnx") / "policy.onnx")


@pytest.mark.slow
@pytest.mark.parametrize("attack", ["none", "zo"])
def test_a_dqn_in_an_onnx_file_decides_like_the_zoos(onnx: str, attack: str) -> None:
    own, ours = driven(f"attack={attack}", "victim=onnx", f"victim.path={onnx}"), driven(f"attack={attack}")
    for name in ("steps", "crashed", "offroad", "action_counts", "distance_m", "queries"):
        np.testing.assert_array_equal(own[name], ours[name], err_msg=name)


def test_a_gradient_attack_on_a_black_box_is_refused_before_any_work() -> None:
    with pytest.raises(UserError, match="victim 'onnx' is a black box that supports 'scores' at most"):
        plan_of(["attack=pgd", "victim=onnx", "victim.path=nowhere.onnx"])
    plan_of(["attack=zo", "victim=onnx", "victim.path=nowhere.onnx"])


@pytest.mark.slow
def test_it_keeps_the_rules(onnx: str) -> None:
    assert broken("victim", "onnx", path=onnx) == {}


class TwoOutputs(nn.Module):
    """A mean and the logarithm of a deviation, as SAC's actors return, or logits and a value."""

    def __init__(self, other: int) -> None:
        super().__init__()
        self.first, self.other = nn.Linear(50, 2), nn.Linear(50, other)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        return self.first(observation.flatten(1)), self.other(observation.flatten(1))


@pytest.mark.parametrize(("other", "fits"), [(1, True), (2, False)])
def test_an_onnx_file_with_two_outputs_that_could_drive_is_refused(other: int, fits: bool, tmp_path: Path) -> None:
    path = onnx_file(tmp_path / "two.onnx", TwoOutputs(other))
    victim = choose("victim", "onnx", path=path, actions="continuous").component
    if fits:
        assert victim.load(0, FACTS).scores(torch.zeros(3, 10, 5)).shape == (3, 2)
        return
    with pytest.raises(UserError, match="of 2 numbers each: export the one that drives alone"):
        victim.load(0, FACTS)


def test_without_onnx_runtime_the_error_has_the_install_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    (tmp_path / "policy.onnx").write_bytes(b"")
    with pytest.raises(UserError, match=r"needs ONNX Runtime: pip install 'cavbench\[onnx\]'"):
        choose("victim", "onnx", path=str(tmp_path / "policy.onnx")).component.load(0, FACTS)
