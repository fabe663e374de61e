"""The rules for whatever a victim or a defence loads, drivers and detectors alike."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from torch import Tensor, nn

from bench.conformance.check import NotApplicableError, require
from bench.plugins.contracts import Victim
from bench.plugins.fingerprint import state_digest


def check_frozen(network: nn.Module, noun: str) -> None:
    """Eval mode, and no gradients on weights."""
    require(not network.training, f"it is in training mode: load must return {noun}.eval()")
    require(
        not any(weight.requires_grad for weight in network.parameters()),
        f"its weights take gradients: load must return {noun}.requires_grad_(False)",
    )


def check_white_box(victim: Victim) -> None:
    """Skip where the victim says that it has no gradients."""
    if victim.answers != "gradients":
        raise NotApplicableError(f"it answers {victim.answers} at most: gradient attacks are refused")


def check_gradient(gradient: Tensor) -> None:
    """A way back that leads somewhere."""
    require(bool(gradient.isfinite().all()), "its gradient is NaN or infinite somewhere")
    require(
        bool(gradient.any()),
        "its gradient is 0 everywhere, a wall that proves nothing: let it pass straight through (Athalye et al. 2018)",
    )


@contextmanager
def unchanged(network: nn.Module, own: Callable[[], nn.Module]) -> Iterator[None]:
    """What is done in the block changes no weights of the network, nor of the victim's `own`, loaded anew."""
    before = state_digest(network), state_digest(own())
    yield
    require(state_digest(network) == before[0], "its weights changed while it was asked")
    require(state_digest(own()) == before[1], "loading it changed the victim's own weights")
