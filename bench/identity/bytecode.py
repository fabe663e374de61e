"""Hashes the code of objects that no package ships: classes of a script or a notebook, whose source file may not exist."""

from __future__ import annotations

import inspect
import sys
import types
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from cavbench.identity.content import content, is_empty
from cavbench.identity.fingerprint import digest

PLAIN = (bool, int, float, complex, str, bytes, type(None))
LIBRARIES = (
    "cavbench",
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
    """sha256 of the code of classes and functions, with what they use of their own modules and of others of the user.

    The compiled code counts, so comments and layout do not; another version of Python gives another hash. Followed are base
    classes, and the functions, classes and values (numbers, tables, networks) that the code names; libraries are not.

    Args:
        objects: classes, functions or instances of classes.
    """
    seen: dict[str, Any] = {}
    for item in objects:
        _follow(item if isinstance(item, type | types.FunctionType) else type(item), seen)
    return digest(seen)


def _follow(item: Any, seen: dict[str, Any]) -> None:
    name = f"{item.__module__}.{item.__qualname__}"
    if name in seen or _is_library(item.__module__):
        return
    seen[name] = None
    if isinstance(item, types.FunctionType):
        seen[name] = _function(item, seen)
        return
    for base in item.__bases__:
        _follow(base, seen)
    values = {key: value for key, value in vars(item).items() if not (key.startswith("__") and key != "__init__")}
    seen[name] = {key: _value(value, seen) for key, value in sorted(values.items())}


@cache
def _is_library(module: str | None) -> bool:
    """Whether a module is no code of the user's: of Python, of the libraries that records name, or installed."""
    # What was made by `exec` may be in no module.
    top = (module or "__main__").partition(".")[0]
    file = getattr(sys.modules.get(top), "__file__", None) or ""
    installed = bool({"site-packages", "dist-packages"} & set(Path(file).parts))
    return top in LIBRARIES or (top in sys.stdlib_module_names and top != "__main__") or installed


def _function(function: types.FunctionType, seen: dict[str, Any]) -> list[Any]:
    """Its code, its defaults and its closure; what it names of its own module, or of another one of the user's, is followed."""
    names = sorted(set(_names(function.__code__)))
    for name in names:
        if name not in function.__globals__:
            continue
        used = function.__globals__[name]
        if isinstance(used, types.ModuleType):
            if not _is_library(used.__name__):
                for inner in (inner for inner in names if hasattr(used, inner)):
                    _use(f"{used.__name__}.{inner}", getattr(used, inner), seen)
        else:
            _use(f"{function.__module__}.{name}", used, seen)
    closure = [cell.cell_contents for cell in function.__closure__ or () if not is_empty(cell)]
    given = [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values(), *closure]
    return [_code(function.__code__), *(_value(value, seen) for value in given)]


def _use(name: str, used: Any, seen: dict[str, Any]) -> None:
    """Follow what code uses by its name: a class or a function, or a number, a network or a table that it reads."""
    if isinstance(used, type | types.FunctionType):
        _follow(used, seen)
    elif not isinstance(used, types.ModuleType | types.BuiltinFunctionType) and name not in seen:
        seen[name] = None
        seen[name] = _value(used, seen)


def _value(value: Any, seen: dict[str, Any]) -> Any:
    """What stands for an attribute, a default or a closed-over value: its code, or its text if that is stable."""
    value = inspect.unwrap(value) if callable(value) else value
    match value:
        case staticmethod() | classmethod():
            return _value(value.__func__, seen)
        case property():
            return [_value(part, seen) for part in (value.fget, value.fset) if part]
        case types.FunctionType():
            return _function(value, seen)
        case type():
            _follow(value, seen)
            return f"{value.__module__}.{value.__qualname__}"
        case tuple() | list():
            return [_value(part, seen) for part in value]
        case _:
            if isinstance(value, PLAIN):
                return repr(value)
            # An object of the user's: its code and what it holds.
            _follow(type(value), seen)
            return content(value)


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


def content_of(given: Any) -> str:
    """sha256 of all that an object holds, its networks among it, and of the code of its class."""
    return digest([code_of(given), content(vars(given))])
