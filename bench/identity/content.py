"""A hash of the content of a Python value: of numbers, texts, tensors, containers, objects, and the code of functions."""

from __future__ import annotations

import hashlib
import inspect
import random
import types
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

DEEPEST = 12
"""Values inside of values are looked at down to this depth."""


def content(value: object) -> str:
    """sha256 of a value's content: two values with the same hash hold the same numbers. It is the same in every process.

    An object is hashed by its attributes. Of what holds itself, of what is too deep, and of an object of an extension, whose
    content Python does not see, the type counts only.
    """
    found = hashlib.sha256()
    for part in _parts(value, DEEPEST, frozenset()):
        found.update(len(part).to_bytes(8, "little") + part)
    return found.hexdigest()


def _parts(value: Any, depth: int, above: frozenset[int]) -> Iterator[bytes]:
    """The content of a value as bytes."""
    yield f"{type(value).__module__}.{type(value).__qualname__}".encode()
    if isinstance(value, Tensor):
        yield f"{value.dtype}{tuple(value.shape)}{value.requires_grad}".encode()
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
    elif isinstance(value, type | types.ModuleType | types.BuiltinFunctionType):
        yield str(getattr(value, "__qualname__", value.__name__)).encode()
    elif depth and id(value) not in above:
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
        yield sorted(map(content, value))
    elif isinstance(value, types.MethodType):
        yield from (value.__self__, value.__func__)
    elif isinstance(value, types.FunctionType):
        yield from (value.__code__, value.__defaults__, value.__kwdefaults__)
        # What a function that was made in another one remembers.
        yield from (cell.cell_contents for cell in value.__closure__ or () if not is_empty(cell))
    elif isinstance(value, types.CodeType):
        yield from (value.co_code, value.co_consts, value.co_names)
    elif hasattr(value, "cache_info"):
        yield from (tuple(value.cache_info()), inspect.unwrap(value))
    else:
        yield from (vars(value) if hasattr(value, "__dict__") else None, _of_slots(value))


def _of_slots(value: Any) -> dict[str, Any]:
    """The attributes of an object that has slots."""
    names = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ()) if isinstance(name, str)]
    return {name: getattr(value, name) for name in sorted(set(names)) if name[:2] != "__" and hasattr(value, name)}


def is_empty(cell: types.CellType) -> bool:
    """Whether a closed-over name has no value yet."""
    try:
        cell.cell_contents  # noqa: B018
    except ValueError:
        return True
    return False
