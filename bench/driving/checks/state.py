"""Common code for checks of a memory: validates and compares states."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from cavbench.checks.check import NotApplicableError, require
from cavbench.driving import Policy, State

RTOL, ATOL = 1e-4, 1e-5
"""Tolerances for rounding, which depends on the number of observations in a batch."""


def not_noisy(policy: Policy) -> None:
    """Leave a check out for a policy that draws noise for every answer, as it declares."""
    if policy.noise:
        raise NotApplicableError("it adds noise to what it sees, as declared (noise above 0)")


def check_state(state: object, method: str, episodes: int) -> None:
    """Raise BrokenRuleError unless a state is None, or a TensorDict with one row per episode and without a graph.

    Args:
        state: the returned state.
        method: name of the method that returned it.
        episodes: number of episodes.
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
        f"the state of {method} has batch size {list(state.batch_size)}, not [{episodes}]: use one row per episode",
    )
    graph = any(value.requires_grad for value in state.values(True, True))
    require(not graph, f"the state of {method} carries a graph: detach its tensors")


def same(first: State, second: State) -> bool:
    """Whether two states are equal to the last bit."""
    if first is None or second is None:
        return first is second
    return set(first.keys(True, True)) == set(second.keys(True, True)) and all(
        torch.equal(value, second[name]) for name, value in first.items(True, True)
    )


def close(first: State, second: State) -> bool:
    """Whether two states with the same entries are equal, except for rounding."""
    if first is None or second is None:
        return first is second
    return all(
        torch.allclose(value.double(), second[name].double(), rtol=RTOL, atol=ATOL)
        for name, value in first.items(True, True)
    )


def named(state: State) -> str:
    """A remark with the entries of a state."""
    if state is None:
        return "it has no memory"
    entries = ", ".join(sorted(map(str, state.keys())))
    return f"its memory: {entries}" if entries else "its memory has no entries"
