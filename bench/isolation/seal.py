"""A seal on the code that enforces and measures: a unit is refused if a plug-in replaced one of its functions."""

from __future__ import annotations

from collections.abc import Iterator
from types import CodeType, FunctionType, ModuleType

from cavbench.isolation.watch import TamperError


class Seal:
    """The functions and methods of some modules as they are when the seal is made.

    Args:
        modules: modules of `cavbench`; make the seal before any plug-in can be imported.
    """

    def __init__(self, *modules: ModuleType) -> None:
        self._modules = modules
        self._found = dict(self._functions())

    def check(self) -> None:
        """Raise TamperError if a function or a method was replaced, added or removed."""
        now = dict(self._functions())
        if now != self._found:
            changed = sorted(name for name in {*now, *self._found} if now.get(name) != self._found.get(name))
            raise TamperError(f"{', '.join(changed)} was replaced while the run was measured", "attack", "defense")

    def _functions(self) -> Iterator[tuple[str, tuple[int, CodeType | None]]]:
        for module in self._modules:
            for name, value in vars(module).items():
                yield from _codes(f"{module.__name__}.{name}", value)
                if isinstance(value, type) and value.__module__ == module.__name__:
                    for inner, method in vars(value).items():
                        yield from _codes(f"{module.__name__}.{name}.{inner}", method)


def _codes(name: str, value: object) -> Iterator[tuple[str, tuple[int, CodeType | None]]]:
    inner = (
        getattr(value, "fget", None) or getattr(value, "__func__", None) or getattr(value, "__wrapped__", None) or value
    )
    if isinstance(inner, FunctionType):
        yield name, (id(value), inner.__code__)
    elif callable(value):
        yield name, (id(value), None)
