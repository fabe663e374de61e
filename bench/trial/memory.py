"""What a network keeps from one call to the next outside of its contract: in tensors, lists, counters and random generators."""

from __future__ import annotations

import hashlib
import random
from collections import deque
from collections.abc import Iterator, Mapping
from types import FunctionType, MethodType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

OF_TORCH = frozenset(vars(nn.Module()))
"""Attributes of every module. Parameters and buffers are looked at by themselves."""
DEEPEST = 8
"""Values inside of values are looked at down to this depth."""


def kept(network: nn.Module) -> Mapping[str, str]:
    """A hash of everything that the modules of a network hold, by its name: parameters, buffers and attributes of Python.

    The same call before and after some queries shows what the queries changed.
    """
    found = {name: _hash(value) for name, value in (*network.named_parameters(), *network.named_buffers())}
    for prefix, module in network.named_modules():
        for name, value in vars(module).items():
            if name not in OF_TORCH:
                found[f"{prefix}.{name}" if prefix else name] = _hash(value)
    return found


def changed(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """The names of what is not the same in both."""
    return sorted(name for name in {*before, *after} if before.get(name) != after.get(name))


def _hash(value: object) -> str:
    found = hashlib.sha256()
    for part in _parts(value, DEEPEST, set()):
        found.update(part)
    return found.hexdigest()


def _parts(value: Any, depth: int, above: set[int]) -> Iterator[bytes]:
    """The content of a value as bytes; a value that contains itself, and one that is too deep, by its type only."""
    yield type(value).__qualname__.encode()
    if isinstance(value, Tensor):
        yield f"{value.dtype}{tuple(value.shape)}".encode()
        yield value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
    elif isinstance(value, np.ndarray | np.generic):
        yield f"{value.dtype}{value.shape}".encode() + (b"" if value.dtype.hasobject else value.tobytes())
    elif isinstance(value, torch.Generator):
        yield value.get_state().numpy().tobytes()
    elif isinstance(value, random.Random):
        yield repr(value.getstate()).encode()
    elif isinstance(value, np.random.Generator | np.random.RandomState):
        state = value.bit_generator.state if isinstance(value, np.random.Generator) else value.get_state()
        yield repr(state).encode()
    elif value is None or isinstance(value, bool | int | float | complex | str | bytes):
        yield repr(value).encode()
    elif depth and id(value) not in above and not isinstance(value, type):
        for part in _inner(value):
            yield from _parts(part, depth - 1, above | {id(value)})


def _inner(value: Any) -> Iterator[Any]:
    """The values inside of a value."""
    if isinstance(value, Mapping):
        for item in value.items():
            yield from item
    elif isinstance(value, list | tuple | deque):
        yield from value
    elif isinstance(value, set | frozenset):
        yield sorted(map(_hash, value))
    elif isinstance(value, MethodType):
        yield value.__self__
    elif isinstance(value, FunctionType):
        # What a function that was made in another one remembers.
        yield from (cell.cell_contents for cell in value.__closure__ or () if not _is_empty(cell))
    elif hasattr(value, "cache_info"):
        yield tuple(value.cache_info())
    elif hasattr(value, "__dict__"):
        yield vars(value)


def _is_empty(cell: Any) -> bool:
    try:
        return cell.cell_contents is cell
    except ValueError:
        return True
