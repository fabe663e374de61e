"""What a network keeps from one call to the next outside of its contract: in tensors, lists, counters and random generators."""

from __future__ import annotations

from collections.abc import Mapping

from torch import nn

from cavbench.identity.bytecode import code_of
from cavbench.identity.content import content

GLOBALS = "a global value of its code"
OF_TORCH = frozenset(vars(nn.Module()))
"""Attributes of every module. Parameters and buffers are looked at by themselves."""


def kept(network: nn.Module) -> Mapping[str, str]:
    """A hash of everything that the modules of a network hold, by its name: parameters, buffers, attributes, and global values.

    The same call before and after some queries shows what the queries changed.
    """
    found = {name: content(value) for name, value in (*network.named_parameters(), *network.named_buffers())}
    for prefix, module in network.named_modules():
        for name, value in vars(module).items():
            if name not in OF_TORCH:
                found[f"{prefix}.{name}" if prefix else name] = content(value)
    # Numbers and lists of the user's modules that the code reads, too.
    return found | {GLOBALS: code_of(*network.modules())}


def changed(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """The names of what is not the same in both."""
    return sorted(name for name in {*before, *after} if before.get(name) != after.get(name))
