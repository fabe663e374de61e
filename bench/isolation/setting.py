"""A setting of a process: how it is read, and when a later value harms nobody."""

from __future__ import annotations

import operator
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

UNKNOWN = object()


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A setting of the process.

    Args:
        name: what it is called in errors.
        read: returns its value, which later changes do not reach.
        write: sets it; None for what cannot be put back.
        kept: whether a later value does others no harm, from the value before and the later one.
        module: a module that must be imported before it can be read; empty for none.
        usual: its value while that module is not imported.
    """

    name: str
    read: Callable[[], Any]
    write: Callable[[Any], object] | None = None
    kept: Callable[[Any, Any], bool] = operator.eq
    module: str = ""
    usual: Any = UNKNOWN

    def now(self) -> Any:
        """Its value; `UNKNOWN` if it cannot be read."""
        if self.module and self.module not in sys.modules:
            return self.usual
        try:
            return self.read()
        # A plug-in may have broken what reads it.
        except Exception:
            return UNKNOWN


def in_order(before: Sequence[object], after: Sequence[object]) -> bool:
    """Whether all that was in a list is there, in the same order."""
    rest = iter(after)
    return all(any(one is other or one == other for other in rest) for one in before)


def same_objects(before: Mapping[Any, object], after: Mapping[Any, object]) -> bool:
    """Whether all that was there is there, unchanged."""
    return all(after.get(key) is value for key, value in before.items())


def same_values(before: Mapping[Any, object], after: Mapping[Any, object]) -> bool:
    return all(after.get(key) == value for key, value in before.items())
