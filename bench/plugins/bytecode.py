"""Hashes the code of objects that no package ships: classes of a script or a notebook, whose source file may not exist."""

from __future__ import annotations

import inspect
import types
from collections.abc import Iterator
from typing import Any

from bench.plugins.fingerprint import digest

PLAIN = (bool, int, float, complex, str, bytes, type(None))
LIBRARIES = (
    "bench",
    "torch",
    "torchrl",
    "tensordict",
    "stable_baselines3",
    "gymnasium",
    "numpy",
    "abc",
    "builtins",
    "typing",
)
"""Top-level modules whose classes are not hashed: records name their versions, or the code digest covers them."""


def code_of(*objects: Any) -> str:
    """sha256 of the code of classes and functions, with what they use of their own modules.

    The compiled code counts, so comments and layout do not; another version of Python gives another hash. Followed are base
    classes, and the functions, classes and plain constants of the same module that the code names.

    Args:
        objects: classes, functions or instances of classes.
    """
    seen: dict[str, Any] = {}
    for item in objects:
        _follow(item if isinstance(item, type | types.FunctionType) else type(item), seen)
    return digest(seen)


def _follow(item: Any, seen: dict[str, Any]) -> None:
    name = f"{item.__module__}.{item.__qualname__}"
    if name in seen or item.__module__.partition(".")[0] in LIBRARIES:
        return
    seen[name] = None
    if isinstance(item, types.FunctionType):
        seen[name] = _function(item, seen)
        return
    for base in item.__bases__:
        _follow(base, seen)
    values = {key: value for key, value in vars(item).items() if not (key.startswith("__") and key != "__init__")}
    seen[name] = {key: _value(value, item.__module__, seen) for key, value in sorted(values.items())}


def _function(function: types.FunctionType, seen: dict[str, Any]) -> list[Any]:
    """Its code, its defaults and its closure; what it names of its own module is followed."""
    for name in sorted(set(_names(function.__code__))):
        used = function.__globals__.get(name)
        if isinstance(used, (*PLAIN, tuple)):
            seen[f"{function.__module__}.{name}"] = repr(used)
        elif isinstance(used, type | types.FunctionType) and used.__module__ == function.__module__:
            _follow(used, seen)
    closure = [cell.cell_contents for cell in function.__closure__ or () if not _empty(cell)]
    given = [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values(), *closure]
    return [_code(function.__code__), *(_value(value, function.__module__, seen) for value in given)]


def _value(value: Any, module: str, seen: dict[str, Any]) -> Any:
    """What stands for an attribute, a default or a closed-over value: its code, or its text if that is stable."""
    value = inspect.unwrap(value) if callable(value) else value
    match value:
        case staticmethod() | classmethod():
            return _value(value.__func__, module, seen)
        case property():
            return [_value(part, module, seen) for part in (value.fget, value.fset) if part]
        case types.FunctionType():
            return _function(value, seen)
        case type():
            if value.__module__ == module:
                _follow(value, seen)
            return f"{value.__module__}.{value.__qualname__}"
        case tuple() | list():
            return [_value(part, module, seen) for part in value]
        case _:
            return repr(value) if isinstance(value, PLAIN) else type(value).__qualname__


def _code(code: types.CodeType) -> list[Any]:
    constants = [_code(part) if isinstance(part, types.CodeType) else _constant(part) for part in code.co_consts]
    return [code.co_code.hex(), constants, code.co_names, code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]]


def _constant(value: Any) -> str:
    # The order of a set depends on the process.
    return repr(sorted(value, key=repr)) if isinstance(value, frozenset) else repr(value)


def _names(code: types.CodeType) -> Iterator[str]:
    yield from code.co_names
    for part in code.co_consts:
        if isinstance(part, types.CodeType):
            yield from _names(part)


def _empty(cell: types.CellType) -> bool:
    try:
        cell.cell_contents  # noqa: B018
    except ValueError:
        return True
    return False


def plain_attributes(module: Any) -> dict[str, Any]:
    """The structure and the plain attributes of a `torch.nn.Module` and its parts: what its weights do not say."""
    found: dict[str, Any] = {"": repr(module)}
    for name, part in module.named_modules():
        own = {key: value for key, value in vars(part).items() if not key.startswith("_") and key != "training"}
        found[name] = {key: repr(value) for key, value in sorted(own.items()) if isinstance(value, (*PLAIN, tuple))}
    return found
