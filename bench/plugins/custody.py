"""Data that foreign code can reach and must not change: what they were, what was changed, and how to put them back."""

from __future__ import annotations

import sys
from abc import ABCMeta
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from types import FunctionType, MappingProxyType, ModuleType, SimpleNamespace
from typing import Any

PLAIN = (type(None), bool, int, float, complex, str, bytes)
"""Values that cannot be changed: two equal ones are the same."""
LARGEST_BYTES = 1 << 20
"""Of larger arrays a hash is kept, not a copy: they are compared, but cannot be put back."""
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
            waiting.extend((_joined(name, key), inner) for key, inner in kind.inside(content))
        if self._arrays:
            self._nodes = {key: node for key, node in self._nodes.items() if node.kind is _ARRAY}

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

    def _kind(self, value: object) -> _Kind | None:
        """How to look into a value; None for one that is compared by identity."""
        if isinstance(value, ModuleType):
            return _MODULE if self._functions else _CONSTANTS
        for types, kind in _CONTAINERS:
            if isinstance(value, types):
                return kind
        if _is_tensordict(value):
            return _TENSORS
        if _is_array(value):
            return _ARRAY
        if isinstance(value, FunctionType):
            return _FUNCTION if self._functions and self._is_own(value.__module__) else None
        if isinstance(value, type):
            # Libraries keep books on classes that they make: TorchRL on those of environments.
            plain = type(value) in (type, ABCMeta) and self._is_own(value.__module__)
            return (_CLASS if self._functions else _DATA) if plain else None
        known = isinstance(value, SimpleNamespace) or _is_network(value) or self._is_own(type(value).__module__)
        return _INSTANCE if known and hasattr(value, "__dict__") else None

    def _is_own(self, module: object) -> bool:
        return isinstance(module, str) and module.partition(".")[0] in self._packages


def listed(names: Iterable[str]) -> str:
    """At most `SHOWN` names as text; empty for none."""
    found = sorted(set(names))
    more = f" and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
    return ", ".join(found[:SHOWN]) + more


def forget_computed(owner: object) -> None:
    """Remove what a class computes once from the attributes of an instance (`functools.cached_property`)."""
    for key in [key for key in vars(owner) if _is_computed(type(owner), key)]:
        del vars(owner)[key]


@dataclass(slots=True, frozen=True)
class _Node:
    """An object in custody, and its content. The reference keeps it alive: no other gets its address."""

    name: str
    value: Any
    kind: _Kind
    content: Any


@dataclass(frozen=True, kw_only=True)
class _Kind:
    """How to look into objects of a kind.

    Args:
        content: what is in one, as a copy: by key, a sequence, or bytes.
        put_back: gives an object an earlier content.
    """

    content: Callable[[Any], Any]
    put_back: Callable[[Any, Any], None]

    def seen(self, value: Any) -> Any:
        """What is in an object; None for one that does not let itself be looked at."""
        try:
            return self.content(value)
        # Foreign classes may do anything when they are looked at.
        except Exception:
            return None

    def inside(self, content: Any) -> Iterator[tuple[str, object]]:
        """What to look into further, by key."""
        if isinstance(content, dict):
            yield from ((str(key), value) for key, value in content.items())
        elif isinstance(content, tuple):
            yield from ((str(place), value) for place, value in enumerate(content))

    def differences(self, name: str, before: Any, now: Any) -> Iterator[str]:
        """The names of what differs between two contents."""
        if type(before) is not type(now):
            yield name
        elif isinstance(before, dict):
            for key in {**before, **now}:
                if key not in before or key not in now or not _same(before[key], now[key]):
                    yield _joined(name, str(key))
        elif isinstance(before, tuple):
            if len(before) != len(now) or not all(map(_same, before, now)):
                yield name
        elif before != now:
            yield name


def _joined(name: str, key: str) -> str:
    return f"{name}.{key}" if name else key


def _same(first: object, second: object) -> bool:
    if first is second:
        return True
    if type(first) is not type(second):
        return False
    if isinstance(first, PLAIN):
        return first == second or (first != first and second != second)
    # A tuple cannot be changed: another one of the same values is no difference.
    if isinstance(first, tuple) and isinstance(second, tuple):
        return len(first) == len(second) and all(map(_same, first, second))
    return False


def _put_dict(owner: Any, content: dict[Any, Any]) -> None:
    owner.clear()
    owner.update(content)


def _put_tensors(owner: Any, content: dict[str, Any]) -> None:
    for key in set(owner.keys()) - content.keys():
        del owner[key]
    owner.update(content)


def _put_list(owner: Any, content: tuple[Any, ...]) -> None:
    owner.clear()
    owner.extend(content)


def _put_set(owner: Any, content: frozenset[Any]) -> None:
    owner.clear()
    owner.update(content)


def _put_nothing(owner: Any, content: Any) -> None:
    """What cannot be changed needs not be put back."""


def _is_array(value: object) -> bool:
    numpy, torch = sys.modules.get("numpy"), sys.modules.get("torch")
    return (numpy is not None and isinstance(value, numpy.ndarray)) or (
        torch is not None and isinstance(value, torch.Tensor)
    )


def _is_tensordict(value: object) -> bool:
    tensordict = sys.modules.get("tensordict")
    return tensordict is not None and isinstance(value, tensordict.TensorDictBase)


def _is_network(value: object) -> bool:
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.nn.Module)


def _bytes(array: Any) -> tuple[object, ...] | bytes:
    """The shape, type and bytes of an array or tensor."""
    if getattr(array, "is_meta", False) or getattr(array, "layout", None) is _sparse():
        return b""
    numbers = array.detach().cpu().contiguous().numpy() if hasattr(array, "detach") else array
    if numbers.dtype.hasobject:
        return tuple(numbers.ravel().tolist())
    form = repr((str(array.dtype), tuple(array.shape))).encode()
    if array.nbytes > LARGEST_BYTES:
        return b"#" + form + blake2b(_in_a_row(numbers).data).digest()
    return form + numbers.tobytes()


def _in_a_row(numbers: Any) -> Any:
    """The bytes of an array, in one row."""
    numpy = sys.modules["numpy"]
    return numpy.ascontiguousarray(numbers).reshape(-1).view(numpy.uint8)


def _sparse() -> object:
    torch = sys.modules.get("torch")
    return object() if torch is None else torch.sparse_coo


def _put_array(array: Any, content: Any) -> None:
    numpy = sys.modules["numpy"]
    if not isinstance(content, bytes) or not content or content.startswith(b"#"):
        return
    size = array.nbytes
    held = array.detach() if hasattr(array, "detach") else array
    numbers = held.cpu().contiguous().numpy() if hasattr(held, "cpu") else held
    values = numpy.frombuffer(content[len(content) - size :], numbers.dtype).reshape(numbers.shape)
    if hasattr(held, "copy_"):
        held.copy_(sys.modules["torch"].from_numpy(values.copy()))
    else:
        held[...] = values


def _attributes(owner: Any) -> dict[str, Any]:
    """The attributes of an instance, without those that its class computes once from the others."""
    return {key: value for key, value in vars(owner).items() if not _is_computed(type(owner), key)}


def _is_computed(owner: type, key: str) -> bool:
    return isinstance(getattr(owner, key, None), cached_property)


def _put_attributes(owner: Any, content: dict[str, Any]) -> None:
    vars(owner).clear()
    vars(owner).update(content)


def _members(owner: type) -> dict[str, Any]:
    """The members of a class that are not Python's own."""
    return {key: value for key, value in vars(owner).items() if not key.startswith(("__", "_abc_"))}


def _is_code(value: object) -> bool:
    """Whether it is a function, a method, a property or a class."""
    return callable(value) or hasattr(value, "__get__")


def _data_of(owner: type) -> dict[str, Any]:
    """The members of a class that are no code."""
    return {key: value for key, value in _members(owner).items() if not _is_code(value)}


def _put_data(owner: type, content: dict[str, Any]) -> None:
    for key in _data_of(owner).keys() - content.keys():
        type.__delattr__(owner, key)
    for key, value in content.items():
        if vars(owner).get(key) is not value:
            type.__setattr__(owner, key, value)


def _put_members(owner: type, content: dict[str, Any]) -> None:
    for key, value in _members(owner).items():
        if key not in content:
            type.__delattr__(owner, key)
        elif value is not content[key]:
            type.__setattr__(owner, key, content[key])
    for key in content.keys() - vars(owner).keys():
        type.__setattr__(owner, key, content[key])


def _globals(module: ModuleType) -> dict[str, Any]:
    """The names of a module, without its submodules, which are imported when they are needed."""
    return {
        key: value
        for key, value in list(vars(module).items())
        if not key.startswith("__") and not isinstance(value, ModuleType)
    }


def _constants(module: ModuleType) -> dict[str, Any]:
    """The names of a module that are no code, and its classes; `_lower` names are caches, which change."""
    return {
        key: value
        for key, value in _globals(module).items()
        if isinstance(value, type) or not (_is_code(value) or (key.startswith("_") and key.islower()))
    }


def _put_globals(module: ModuleType, content: dict[str, Any]) -> None:
    for key in _globals(module).keys() - content.keys():
        del vars(module)[key]
    vars(module).update(content)


def _put_constants(module: ModuleType, content: dict[str, Any]) -> None:
    for key in _constants(module).keys() - content.keys():
        del vars(module)[key]
    vars(module).update(content)


def _of_function(function: FunctionType) -> dict[str, Any]:
    """What a function remembers: its defaults, its attributes and what it closes over."""
    cells = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        try:
            cells[name] = cell.cell_contents
        except ValueError:  # It is not filled yet.
            continue
    given = {"defaults": function.__defaults__, "keywords": tuple((function.__kwdefaults__ or {}).items())}
    attributes = {key: value for key, value in vars(function).items() if key != "__wrapped__"}
    return {**given, **{f"attribute {key}": value for key, value in attributes.items()}, **cells}


def _put_function(function: FunctionType, content: dict[str, Any]) -> None:
    function.__defaults__ = content["defaults"]
    function.__kwdefaults__ = dict(content["keywords"]) or None
    own = {key.removeprefix("attribute "): value for key, value in content.items() if key.startswith("attribute ")}
    for key in vars(function).keys() - own.keys() - {"__wrapped__"}:
        del vars(function)[key]
    vars(function).update(own)
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        if name in content:
            cell.cell_contents = content[name]


_DICT = _Kind(content=dict, put_back=_put_dict)
_TENSORS = _Kind(content=lambda owner: dict(owner.items()), put_back=_put_tensors)
_LIST = _Kind(content=tuple, put_back=_put_list)
_SET = _Kind(content=frozenset, put_back=_put_set)
_FIXED = _Kind(content=tuple, put_back=_put_nothing)
_PROXY = _Kind(content=dict, put_back=_put_nothing)
_BYTES = _Kind(content=bytes, put_back=_put_list)
_ARRAY = _Kind(content=_bytes, put_back=_put_array)
_INSTANCE = _Kind(content=_attributes, put_back=_put_attributes)
_CLASS = _Kind(content=_members, put_back=_put_members)
_DATA = _Kind(content=_data_of, put_back=_put_data)
_MODULE = _Kind(content=_globals, put_back=_put_globals)
_CONSTANTS = _Kind(content=_constants, put_back=_put_constants)
_FUNCTION = _Kind(content=_of_function, put_back=_put_function)
_CONTAINERS: tuple[tuple[type | tuple[type, ...], _Kind], ...] = (
    (dict, _DICT),
    ((list, deque), _LIST),
    (set, _SET),
    ((tuple, frozenset), _FIXED),
    (MappingProxyType, _PROXY),
    (bytearray, _BYTES),
)
