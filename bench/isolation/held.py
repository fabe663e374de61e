"""What is in an object that foreign code can reach, by its kind, and how to put it back (`cavbench.isolation.custody`)."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from types import FunctionType, MappingProxyType, ModuleType
from typing import Any

PLAIN = (type(None), bool, int, float, complex, str, bytes)
"""Values that cannot be changed: two equal ones are the same."""
LARGEST_BYTES = 1 << 20
"""Of larger arrays a hash is kept, not a copy: they are compared, but cannot be put back."""


@dataclass(frozen=True, kw_only=True)
class Kind:
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
                if key not in before or key not in now or not same(before[key], now[key]):
                    yield joined(name, str(key))
        elif isinstance(before, tuple):
            if len(before) != len(now) or not all(map(same, before, now)):
                yield name
        elif before != now:
            yield name


def joined(name: str, key: str) -> str:
    return f"{name}.{key}" if name else key


def same(first: object, second: object) -> bool:
    if first is second:
        return True
    if type(first) is not type(second):
        return False
    if isinstance(first, PLAIN):
        return first == second or (first != first and second != second)
    # A tuple cannot be changed: another one of the same values is no difference.
    if isinstance(first, tuple) and isinstance(second, tuple):
        return len(first) == len(second) and all(map(same, first, second))
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


def is_array(value: object) -> bool:
    numpy, torch = sys.modules.get("numpy"), sys.modules.get("torch")
    return (numpy is not None and isinstance(value, numpy.ndarray)) or (
        torch is not None and isinstance(value, torch.Tensor)
    )


def is_tensordict(value: object) -> bool:
    tensordict = sys.modules.get("tensordict")
    return tensordict is not None and isinstance(value, tensordict.TensorDictBase)


def is_network(value: object) -> bool:
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
    return {key: value for key, value in vars(owner).items() if not is_computed(type(owner), key)}


def is_computed(owner: type, key: str) -> bool:
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


DICT = Kind(content=dict, put_back=_put_dict)
TENSORS = Kind(content=lambda owner: dict(owner.items()), put_back=_put_tensors)
LIST = Kind(content=tuple, put_back=_put_list)
SET = Kind(content=frozenset, put_back=_put_set)
FIXED = Kind(content=tuple, put_back=_put_nothing)
PROXY = Kind(content=dict, put_back=_put_nothing)
BYTES = Kind(content=bytes, put_back=_put_list)
ARRAY = Kind(content=_bytes, put_back=_put_array)
INSTANCE = Kind(content=_attributes, put_back=_put_attributes)
CLASS = Kind(content=_members, put_back=_put_members)
DATA = Kind(content=_data_of, put_back=_put_data)
MODULE = Kind(content=_globals, put_back=_put_globals)
CONSTANTS = Kind(content=_constants, put_back=_put_constants)
FUNCTION = Kind(content=_of_function, put_back=_put_function)
CONTAINERS: tuple[tuple[type | tuple[type, ...], Kind], ...] = (
    (dict, DICT),
    ((list, deque), LIST),
    (set, SET),
    ((tuple, frozenset), FIXED),
    (MappingProxyType, PROXY),
    (bytearray, BYTES),
)
