"""Victims from programs of `torch.export` drive like the exported policy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cavbench.core.pair import choose
from cavbench.driving.fused.network import Fused
from tests.checks.rules import broken
from tests.driving.victims.policy_files import (
    FACTS,
    Scores,
    driven,
    torch_file,
)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> str:
    return torch_file(tmp_path_factory.mktemp("torch") / "policy.pt2")


@pytest.mark.slow
@pytest.mark.parametrize("attack", ["none", "zo", "pgd"])
def test_an_exported_dqn_drives_exactly_like_the_zoos(exported: str, attack: str) -> None:
    own, ours = driven(f"attack={attack}", "victim=torch", f"victim.path={exported}"), driven(f"attack={attack}")
    for name in ours:
        np.testing.assert_array_equal(own[name], ours[name], err_msg=name)


@pytest.mark.slow
def test_it_keeps_the_rules(exported: str) -> None:
    assert broken("victim", "torch", path=exported) == {}


def test_a_network_with_flat_input_receives_flat_observations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = torch_file(tmp_path / "flat.pt2", Scores(flat=True), shape=(50,))
    observation = torch.rand(2, 3, 10, 5)
    flat = choose("victim", "torch", path=path).component.load(0, FACTS)
    # A program is torch's; the zoo's own network is compiled where it can be.
    monkeypatch.setattr(Fused, "fits", lambda *_: False)
    assert torch.equal(flat.scores(observation), choose("victim", "dqn").component.load(0, FACTS).scores(observation))
    assert flat.scores(observation[:0]).shape == (0, 3, 5)


class Straight(torch.autograd.Function):
    """Rounds, with the gradient of one that does not."""

    @staticmethod
    def forward(ctx: object, x: Tensor) -> Tensor:
        return (x * 8).round() / 8

    @staticmethod
    def backward(ctx: object, gradient: Tensor) -> Tensor:
        return gradient


class Rounded(Scores):
    def forward(self, observation: Tensor) -> Tensor:
        rounded: Tensor = Straight.apply(observation)
        return super().forward(rounded)


class Held(Scores):
    """Its scores are scaled by a factor that has no gradient."""

    def forward(self, observation: Tensor) -> Tensor:
        return super().forward(observation) * (1 + observation.detach().mean((1, 2))[:, None])


def slope(scores: Tensor, observation: Tensor) -> Tensor:
    return torch.autograd.grad(scores.sum(), observation)[0]


@pytest.mark.parametrize(("network", "kept"), [(Rounded(), False), (Held(), True)])
def test_gradients_that_a_program_keeps_are_those_of_its_module(tmp_path: Path, network: nn.Module, kept: bool) -> None:
    """docs/pitfalls.md: a backward of one's own is lost, so the gradient is 0 and flagged; `detach` holds."""
    loaded = choose("victim", "torch", path=torch_file(tmp_path / "own.pt2", network)).component.load(0, FACTS)
    observation = torch.rand(3, 10, 5, requires_grad=True)
    scores, own = loaded.scores(observation), network(observation)
    torch.testing.assert_close(scores, own)
    expected = slope(own, observation)
    assert expected.count_nonzero()
    torch.testing.assert_close(slope(scores, observation), expected if kept else torch.zeros_like(expected))
