"""Rules for the networks of victims and defences, both policies and detectors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from torch import Tensor, nn

from cavbench.checks.check import NotApplicableError, require
from cavbench.core.contracts import Victim
from cavbench.identity.fingerprint import state_digest


def check_frozen(network: nn.Module, noun: str) -> None:
    """Require eval mode and weights without gradients."""
    require(not network.training, f"it is in training mode: load must return {noun}.eval()")
    require(
        not any(weight.requires_grad for weight in network.parameters()),
        f"its weights require gradients: load must return {noun}.requires_grad_(False)",
    )


def check_white_box(victim: Victim) -> None:
    """Skip a check of gradients if the victim declares that it has none."""
    if victim.answers != "gradients":
        raise NotApplicableError(f"it supports access {victim.answers} at most: gradient attacks are refused")


def check_gradient(gradient: Tensor) -> None:
    """Require a finite, non-zero gradient."""
    require(bool(gradient.isfinite().all()), "its gradient contains NaN or infinity")
    require(
        bool(gradient.any()),
        "its gradient is 0 everywhere, which hides weaknesses: use a straight-through gradient (Athalye et al. 2018)",
    )


@contextmanager
def unchanged(network: nn.Module, load_victim: Callable[[], nn.Module]) -> Iterator[None]:
    """Require that the block changes neither the weights of the network nor those that `load_victim` loads."""
    before = state_digest(network), state_digest(load_victim())
    yield
    require(state_digest(network) == before[0], "its weights changed when it was queried")
    require(state_digest(load_victim()) == before[1], "loading it changed the weights of the victim")
