"""Data that foreign code can reach and must not change: what they were, what was changed, and how to put them back."""

from __future__ import annotations

from abc import ABCMeta
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any

from cavbench.isolation.held import (
    ARRAY,
    CLASS,
    CONSTANTS,
    CONTAINERS,
    DATA,
    FUNCTION,
    INSTANCE,
    MODULE,
    PLAIN,
    TENSORS,
    Kind,
    is_array,
    is_computed,
    is_network,
    is_tensordict,
    joined,
)

SHOWN = 3
"""Most names in a message."""


class Custody:
    """Some objects and everything that can be reached from them, as they are when this is made.

    It goes into containers, arrays, tensors, networks, classes, modules, functions, and instances of classes that some packages
    define. Generators and objects of other libraries are compared by identity.

    Args:
        roots: the objects, by the name that messages use.
        packages: top-level packages whose instances are gone into.
        arrays: whether arrays alone are in custody: what objects hold otherwise may change.
        functions: whether functions are in custody, too: which ones modules and classes have, their defaults, attributes and
            closures.
    """

    def __init__(
        self, roots: Mapping[str, object], packages: Iterable[str], *, functions: bool = True, arrays: bool = False
    ) -> None:
        self._packages, self._functions, self._arrays = frozenset(packages), functions, arrays
        self._nodes: dict[int, _Node] = {}
        self.add(roots)

    def add(self, roots: Mapping[str, object]) -> None:
        """Take more objects into custody."""
        waiting = deque((name, value) for name, value in roots.items())
        while waiting:
            name, value = waiting.popleft()
            if id(value) in self._nodes or isinstance(value, PLAIN):
                continue
            kind = self._kind(value)
            if kind is None:
                continue
            if isinstance(value, type):
                name = f"{value.__module__}.{value.__qualname__}"
            content = kind.seen(value)
            self._nodes[id(value)] = _Node(name, value, kind, content)
            waiting.extend((joined(name, key), inner) for key, inner in kind.inside(content))
        if self._arrays:
            self._nodes = {key: node for key, node in self._nodes.items() if node.kind is ARRAY}

    def changed(self) -> list[str]:
        """The names of what was changed, added or removed."""
        return [
            found
            for node in list(self._nodes.values())
            for found in node.kind.differences(node.name, node.content, node.kind.seen(node.value))
        ]

    def restore(self) -> None:
        """Put everything back as it was."""
        for node in self._nodes.values():
            if any(True for _ in node.kind.differences("", node.content, node.kind.seen(node.value))):
                node.kind.put_back(node.value, node.content)

    def _kind(self, value: object) -> Kind | None:
        """How to look into a value; None for one that is compared by identity."""
        if isinstance(value, ModuleType):
            return MODULE if self._functions else CONSTANTS
        for types, kind in CONTAINERS:
            if isinstance(value, types):
                return kind
        if is_tensordict(value):
            return TENSORS
        if is_array(value):
            return ARRAY
        if isinstance(value, FunctionType):
            return FUNCTION if self._functions and self._is_own(value.__module__) else None
        if isinstance(value, type):
            # Libraries keep books on classes that they make: TorchRL on those of environments.
            plain = type(value) in (type, ABCMeta) and self._is_own(value.__module__)
            return (CLASS if self._functions else DATA) if plain else None
        known = isinstance(value, SimpleNamespace) or is_network(value) or self._is_own(type(value).__module__)
        return INSTANCE if known and hasattr(value, "__dict__") else None

    def _is_own(self, module: object) -> bool:
        return isinstance(module, str) and module.partition(".")[0] in self._packages


def listed(names: Iterable[str]) -> str:
    """At most `SHOWN` names as text; empty for none."""
    found = sorted(set(names))
    more = f" and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
    return ", ".join(found[:SHOWN]) + more


def forget_computed(owner: object) -> None:
    """Remove what a class computes once from the attributes of an instance (`functools.cached_property`)."""
    for key in [key for key in vars(owner) if is_computed(type(owner), key)]:
        del vars(owner)[key]


@dataclass(slots=True, frozen=True)
class _Node:
    """An object in custody, and its content. The reference keeps it alive: no other gets its address."""

    name: str
    value: Any
    kind: Kind
    content: Any
