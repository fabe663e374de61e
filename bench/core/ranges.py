"""Allowed values of parameters, from their annotations: `Annotated[float, Interval(gt=0, le=1)]`, `Literal["a", "b"]`.

The markers Ge, Gt, Le, Lt and Interval are from the annotated-types package.
"""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Iterator
from functools import cache
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, GroupedMetadata, Gt, Le, Lt

Bound = Ge | Gt | Le | Lt
Share = Annotated[float, Ge(0), Le(1)]
"""A number in [0, 1]."""
Positive = Annotated[float, Gt(0)]
"""A number above 0."""
NotNegative = Annotated[float, Ge(0)]
"""A number of at least 0."""
Count = Annotated[int, Ge(1)]
"""A whole number of at least 1."""
Width = Annotated[int, Ge(1), Le(4096)]
"""Size of a layer of a network; its square must fit into memory."""
Natural = Annotated[int, Ge(0)]
"""A whole number of at least 0."""


def check(instance: Any) -> None:
    """Check the fields of a dataclass instance against their annotations.

    Raises:
        ValueError: names in one line the field, what is allowed, and its value.
    """
    kind: Any = type(instance)
    for name, hint in _hints(kind).items():
        value = getattr(instance, name)
        if value is not None and not _allows(hint, value):
            raise ValueError(f"{name} must be {words(hint)}, got {value!r}")


def words(hint: Any) -> str:
    """The allowed values as text: "between 0 and 1", "above 0", "one of a, b"; empty if only the type restricts them."""
    choices = [str(choice) for part in _parts(hint) if get_origin(part) is Literal for choice in get_args(part)]
    if choices:
        return f"one of {', '.join(choices)}"
    low = next((bound for bound in _bounds(hint) if isinstance(bound, Ge | Gt)), None)
    high = next((bound for bound in _bounds(hint) if isinstance(bound, Le | Lt)), None)
    lowest, highest = _number(low), _number(high)
    if low and high:
        closed = isinstance(low, Ge) and isinstance(high, Le)
        ends = ("[" if isinstance(low, Ge) else "(", "]" if isinstance(high, Le) else ")")
        return f"between {lowest} and {highest}" if closed else f"in {ends[0]}{lowest}, {highest}{ends[1]}"
    if low:
        return f"{'at least' if isinstance(low, Ge) else 'above'} {lowest}"
    return f"{'at most' if isinstance(high, Le) else 'below'} {highest}" if high else ""


@cache
def _hints(kind: type) -> dict[str, Any]:
    """The annotations that restrict the values of their fields."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {name: hints[name] for name in getattr(kind, "__dataclass_fields__", {}) if words(hints[name])}


def _parts(hint: Any) -> Iterator[Any]:
    """The alternatives of a union, or the type itself, without the markers."""
    if get_origin(hint) is Annotated:
        yield from _parts(get_args(hint)[0])
    elif get_origin(hint) in (Union, types.UnionType):
        for part in get_args(hint):
            yield from _parts(part)
    else:
        yield hint


def _bounds(hint: Any) -> Iterator[Bound]:
    """The bounds of an annotation, also within a union."""
    if get_origin(hint) in (Union, types.UnionType):
        for part in get_args(hint):
            yield from _bounds(part)
    elif get_origin(hint) is Annotated:
        for marker in get_args(hint)[1:]:
            for bound in marker if isinstance(marker, GroupedMetadata) else (marker,):
                if isinstance(bound, Bound):
                    yield bound


def _allows(hint: Any, value: Any) -> bool:
    choices = [choice for part in _parts(hint) if get_origin(part) is Literal for choice in get_args(part)]
    if choices:
        return value in choices
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return not math.isnan(value) and all(_holds(bound, value) for bound in _bounds(hint))


def _holds(bound: Bound, value: float) -> bool:
    number: Any = _limit(bound)
    match bound:
        case Ge():
            return bool(value >= number)
        case Gt():
            return bool(value > number)
        case Le():
            return bool(value <= number)
        case _:
            return bool(value < number)


def _limit(bound: Bound) -> Any:
    return next(iter(vars(bound).values())) if hasattr(bound, "__dict__") else getattr(bound, bound.__slots__[0])


def _number(bound: Bound | None) -> str:
    return "" if bound is None else f"{_limit(bound):g}"
