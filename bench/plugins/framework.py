"""The functions that score and enforce, as they should be: notices a plug-in that replaces one of them."""

from __future__ import annotations

import builtins
import sys
from collections.abc import Iterator
from types import CodeType, FunctionType, ModuleType

OWN = ("bench", "attacks", "defenses", "envs", "leaderboard")
"""Top-level packages of the framework."""
LIBRARIES = {
    "torch": ("", "Tensor", "nn.Module"),
    "torch.nn.functional": ("",),
    "torch.autograd": ("",),
    "tensordict": ("TensorDict", "TensorDictBase"),
    "numpy": ("",),
    "numpy.linalg": ("",),
    "pyarrow": ("",),
    "math": ("",),
    "time": ("",),
    "random": ("",),
    "hashlib": ("",),
    "json": ("",),
    "pickle": ("",),
}
"""Modules of libraries that scores are computed with; the names are their classes, "" is the module itself."""
SETTINGS = ("manual_seed", "seed", "set_", "load", "save", "compile")
"""Beginnings of the names of library functions that no score depends on, and that other libraries wrap."""
BUILTINS = ["abs", "all", "any", "bool", "dict", "enumerate", "filter", "float", "frozenset", "getattr", "hash", "int", "isinstance", "iter", "len", "list", "map", "max", "min", "next", "range", "repr", "reversed", "round", "set", "setattr", "sorted", "str", "sum", "super", "tuple", "type", "zip"]
Code = tuple[object, CodeType | None]
"""A function and its code; the reference keeps the function alive, so that no other gets its address."""


class Snapshot:
    """The functions and methods of the framework, of all its modules that are imported when the snapshot is made."""

    def __init__(self) -> None:
        self._modules = [module for name, module in sorted(sys.modules.items()) if _belongs(name, module)]
        self._found = dict(self._functions())

    def changed(self) -> str:
        """The names of at most three functions that were replaced or removed since, or added to a class; empty for none."""
        now = dict(self._functions())
        names = [name for name, code in self._found.items() if not _same(code, now.get(name))]
        # Modules may gain functions (submodules that are imported late), classes of the framework may not.
        names += [name for name in now if name not in self._found and name.partition(".")[0] in OWN and ":" in name]
        shown = [name.replace(":", ".") for name in sorted(names)]
        more = f" and {len(shown) - 3} more" if len(shown) > 3 else ""
        return ", ".join(shown[:3]) + more

    def _functions(self) -> Iterator[tuple[str, Code]]:
        for module in self._modules:
            yield from functions(module)
        for name, owners in LIBRARIES.items():
            library = sys.modules.get(name)
            if library is not None:
                for owner in owners:
                    yield from _of_library(name, library, owner)
        for name in BUILTINS:
            yield f"builtins.{name}", code_of(getattr(builtins, name))


def functions(module: ModuleType) -> Iterator[tuple[str, Code]]:
    """The functions of a module, and the methods of its classes as `module.Class:method`."""
    for name, value in list(vars(module).items()):
        if callable(value):
            yield f"{module.__name__}.{name}", code_of(value)
        if isinstance(value, type) and value.__module__ == module.__name__:
            for inner, method in list(vars(value).items()):
                if callable(method) or hasattr(method, "__get__"):
                    yield f"{module.__name__}.{name}:{inner}", code_of(method)


def code_of(value: object) -> Code:
    """A function, method or property, and its code if it is Python's."""
    inner = (
        getattr(value, "fget", None) or getattr(value, "__func__", None) or getattr(value, "__wrapped__", None) or value
    )
    return value, inner.__code__ if isinstance(inner, FunctionType) else None


def _of_library(name: str, library: ModuleType, owner: str) -> Iterator[tuple[str, Code]]:
    place: object = library
    for part in filter(None, owner.split(".")):
        place = getattr(place, part)
    found: dict[str, object] = {}
    for base in reversed(place.__mro__ if isinstance(place, type) else (place,)):
        found |= vars(base)
    for inner, value in found.items():
        # The methods of a class call each other by private names; private functions of a module are its own business.
        if callable(value) and (owner or not inner.startswith("_")) and not inner.startswith(SETTINGS):
            yield ".".join(filter(None, (name, owner, inner))), code_of(value)


def _belongs(name: str, module: ModuleType | None) -> bool:
    return isinstance(module, ModuleType) and name.partition(".")[0] in OWN


def _same(before: Code, now: Code | None) -> bool:
    return now is not None and before[0] is now[0] and before[1] is now[1]
