"""A mapping as a parameter of a component: `world.config={lanes_count: 4}`. It can be hashed, and nobody can change it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any


class Settings(Mapping[str, Any]):
    """Values by name, frozen: mappings in it become `Settings`, lists become tuples. Equal to a dict with the same values.

    Args:
        values: texts, numbers, booleans, None, and lists and mappings of them.

    Raises:
        ValueError: if a key is no text, or a value is something else, which no record could hold.
    """

    __slots__ = ("_values",)
    ordered = True
    """Records keep the order, which may say what is first."""
    _values: dict[str, Any]

    def __init__(self, values: Mapping[str, Any] = {}) -> None:
        object.__setattr__(self, "_values", {_key(name): frozen(value) for name, value in values.items()})

    def __getitem__(self, name: str) -> Any:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError("settings are frozen")

    def __hash__(self) -> int:
        return hash(frozenset(self._values.items()))

    def __reduce__(self) -> tuple[Any, ...]:
        return Settings, (self._values,)

    def __repr__(self) -> str:
        return f"Settings({self})"

    def __str__(self) -> str:
        """As it is written on the command line."""
        return written(self)

    def plain(self) -> dict[str, Any]:
        """The values as a new dict of dicts and lists."""
        return {name: _plain(value) for name, value in self._values.items()}


def _key(name: object) -> str:
    if not isinstance(name, str):
        raise ValueError(f"a name must be text, got {name!r}")
    return name


def frozen(value: Any) -> Any:
    """A value of `Settings`, which nobody can change.

    Raises:
        ValueError: if no record could hold it.
    """
    if isinstance(value, Mapping):
        return value if isinstance(value, Settings) else Settings(value)
    if isinstance(value, list | tuple):
        return tuple(frozen(each) for each in value)
    # Numbers of NumPy.
    if hasattr(value, "item") and getattr(value, "ndim", 1) == 0:
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ValueError(f"must be texts, numbers, lists and mappings of them, got a {type(value).__name__}")


def _plain(value: Any) -> Any:
    if isinstance(value, Settings):
        return value.plain()
    return [_plain(each) for each in value] if isinstance(value, tuple) else value


def written(value: Any) -> str:
    """A value as it is written on the command line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name}: {written(each)}" for name, each in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(written, value)) + "]"
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)
