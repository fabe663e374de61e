"""What the checks of a memory have in common: the form of a state, and whether two states are equal."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from bench.conformance.check import require
from bench.driving import State

RTOL, ATOL = 1e-4, 1e-5
"""Rounding depends on how many observations are scored at once."""


def check_state(state: object, method: str, episodes: int) -> None:
    """Raise BrokenRuleError unless a state is None, or a TensorDict with a row an episode and without a graph.

    Args:
        state: that was returned.
        method: that returned it.
        episodes: there are.
    """
    if state is None:
        return
    require(
        isinstance(state, TensorDictBase),
        f"{method} returned a {type(state).__name__} as the state: return TensorDict({{…}}, batch_size=[B])",
    )
    assert isinstance(state, TensorDictBase)
    require(
        state.batch_size == (episodes,),
        f"the state of {method} has batch size {list(state.batch_size)}, not [{episodes}]: one row an episode",
    )
    graph = any(value.requires_grad for value in state.values(True, True))
    require(not graph, f"the state of {method} carries a graph: detach what you keep")


def same(first: State, second: State) -> bool:
    """Whether two states are equal to the last bit."""
    if first is None or second is None:
        return first is second
    return set(first.keys(True, True)) == set(second.keys(True, True)) and all(
        torch.equal(value, second[name]) for name, value in first.items(True, True)
    )


def close(first: State, second: State) -> bool:
    """Whether two states with the same entries are equal but for rounding."""
    if first is None or second is None:
        return first is second
    return all(
        torch.allclose(value.double(), second[name].double(), rtol=RTOL, atol=ATOL)
        for name, value in first.items(True, True)
    )


def named(state: State) -> str:
    """What is remembered, in a remark."""
    if state is None:
        return "it remembers nothing"
    return f"it remembers {', '.join(sorted(map(str, state.keys())))}"
