"""The functions and data that score and enforce, as they should be: notices a plug-in that replaces one of them."""

from __future__ import annotations

import builtins
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from types import CodeType, FunctionType, ModuleType

from cavbench.isolation.custody import Custody, listed

OWN = "cavbench"
"""The package of the framework."""
BOOKS = ("cavbench.core.registry",)
"""Modules that keep books on what was imported: their data change."""
LIBRARIES = {
    "torch": ("", "Tensor", "nn.Module"),
    "torch.nn.functional": ("",),
    "torch.autograd": ("",),
    "tensordict": ("TensorDict", "TensorDictBase"),
    "numpy": ("",),
    "numpy.linalg": ("",),
    "pyarrow": ("",),
    "pyarrow.compute": ("",),
    "pyarrow.parquet": ("", "ParquetFile", "ParquetWriter"),
    "math": ("",),
    "time": ("",),
    "random": ("",),
    "hashlib": ("",),
    "json": ("",),
    "pickle": ("",),
    "os": ("",),
    "io": ("",),
    "threading": ("", "Thread"),
    "signal": ("",),
    "atexit": ("",),
    "contextlib": ("",),
    "functools": ("",),
    "pathlib": ("", "Path"),
    "subprocess": ("", "Popen"),
    "shutil": ("",),
    "tempfile": ("",),
    "secrets": ("",),
    "re": ("",),
    "copy": ("",),
    "importlib": ("",),
    "importlib.metadata": ("",),
}
"""Modules of libraries that scores are computed and kept with, and processes begin and end with.

The names are their classes, "" is the module.
"""
SETTINGS = ("manual_seed", "seed", "set_", "load", "save", "compile")
"""Beginnings of the names of library functions that no score depends on, and that other libraries wrap."""
BUILTINS = (
    *("abs", "all", "any", "bool", "dict", "enumerate", "filter", "float", "frozenset", "getattr", "hash", "int"),
    *("isinstance", "iter", "len", "list", "map", "max", "min", "next", "range", "repr", "reversed", "round", "set"),
    *("setattr", "sorted", "str", "sum", "super", "tuple", "type", "zip"),
)


class Snapshot:
    """The functions, methods and data of the framework, of all its modules that are imported when the snapshot is made.

    Data are the constants of its modules, the attributes of its classes, and what can be reached from them.
    """

    def __init__(self) -> None:
        self._functions: list[_Function] = []
        self._classes: list[tuple[str, type, frozenset[str]]] = []
        self._known: set[str] = set()
        self._data = Custody({}, (OWN,), functions=False)
        self.extend()
        for name, owners in LIBRARIES.items():
            if name in sys.modules:
                self._add_library(name, sys.modules[name], owners)
        self._functions += [_Function.of("builtins", vars(builtins), name) for name in BUILTINS]

    def extend(self) -> None:
        """Take in the modules of the framework that were imported since."""
        new = [name for name in sys.modules if name.partition(".")[0] == OWN and name not in self._known]
        self._known.update(new)
        modules = {name: sys.modules[name] for name in sorted(new) if isinstance(sys.modules[name], ModuleType)}
        for module in modules.values():
            self._add_module(module)
        self._data.add({name: module for name, module in modules.items() if name not in BOOKS})

    def changed(self) -> str:
        """The names of at most three functions or data that were replaced, changed or removed since, or added to a class.

        Empty for none.
        """
        names = [known.name for known in self._functions if known.is_other()]
        for name, owner, keys in self._classes:
            if len(vars(owner)) != len(keys):
                names += _added(name, owner, keys)
        return listed([*names, *self._data.changed()])

    def restore(self) -> None:
        """Put the data back as they were; functions stay as they are."""
        self._data.restore()

    def _add_module(self, module: ModuleType) -> None:
        for name, value in list(vars(module).items()):
            if callable(value):
                self._functions.append(_Function.of(module.__name__, vars(module), name))
            if isinstance(value, type) and value.__module__ == module.__name__:
                self._add_class(f"{module.__name__}.{name}", value)

    def _add_library(self, name: str, library: ModuleType, owners: tuple[str, ...]) -> None:
        for owner in owners:
            place: object = library
            for part in filter(None, owner.split(".")):
                place = getattr(place, part)
            if isinstance(place, type):
                for base in place.__mro__[:-1]:
                    self._add_class(f"{name}.{owner}", base, SETTINGS)
                continue
            # The private functions of a library's module are its own business.
            keys = [
                key for key, value in vars(place).items() if callable(value) and not key.startswith(("_", *SETTINGS))
            ]
            self._functions += [_Function.of(name, vars(place), key) for key in keys]

    def _add_class(self, name: str, owner: type, without: tuple[str, ...] = ()) -> None:
        self._classes.append((name, owner, frozenset(vars(owner))))
        for key, value in list(vars(owner).items()):
            if (callable(value) or hasattr(value, "__get__")) and not (without and key.startswith(without)):
                self._functions.append(_Function.of(name, vars(owner), key))


@dataclass(slots=True, frozen=True)
class _Function:
    """A function where it is kept, and its code if it is Python's. The reference keeps it alive: no other gets its address."""

    name: str
    place: Mapping[str, object]
    key: str
    value: object
    function: FunctionType | None
    code: CodeType | None

    @classmethod
    def of(cls, where: str, place: Mapping[str, object], key: str) -> _Function:
        value = place[key]
        inner = plain(value)
        function = inner if isinstance(inner, FunctionType) else None
        return cls(f"{where}.{key}", place, key, value, function, function.__code__ if function else None)

    def is_other(self) -> bool:
        now = self.place.get(self.key)
        return now is not self.value or (self.function is not None and self.function.__code__ is not self.code)


def _added(name: str, owner: type, keys: frozenset[str]) -> list[str]:
    """The functions that a class had not; a library's class may gain what it does not inherit."""
    own = name.partition(".")[0] == OWN
    inherited = {key for base in owner.__mro__[1:] for key in vars(base)}
    added = [key for key, value in vars(owner).items() if key not in keys and callable(value)]
    return [f"{name}.{key}" for key in added if own or (key in inherited and not key.startswith(SETTINGS))]


def plain(value: object) -> object:
    """The function in a property, a class method, a static method or a decorated function."""
    return (
        getattr(value, "fget", None) or getattr(value, "__func__", None) or getattr(value, "__wrapped__", None) or value
    )
