"""The entries of an observation: the name, the range and the unit of each, from a space of gymnasium and what was declared."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium import spaces

from cavbench.core.settings import frozen, written
from cavbench.driving.features import Features
from cavbench.errors import UserError

UNBOUNDED = 1e30
"""Bounds beyond this are none: some environments write the largest float32 instead of infinity."""
MOST = 200_000
"""Most entries of an observation."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One number of an observation.

    Args:
        name: its name.
        low, high: its range, in the units of the environment; infinite if nothing is known.
        unit: its unit.
        floor: the resolution of its sensor.
        fixed: whether nobody can forge it.
        column: the name of all entries of its kind, such as `x` of every car; its own name if there are no others.
        present: number of the entry without which there is nothing to measure; -1 for none.
        part: the part of the observation that it belongs to; empty if there are no parts.
    """

    name: str
    low: float
    high: float
    unit: str = ""
    floor: float = 0.0
    fixed: bool = False
    column: str = ""
    present: int = -1
    part: str = ""

    @property
    def known(self) -> bool:
        """Whether it has a range."""
        return -UNBOUNDED < self.low < self.high < UNBOUNDED

    def called(self, name: str) -> bool:
        """Whether this is its name, or that of its kind."""
        return name in (self.name, self.column)


def of_space(space: spaces.Space[Any], name: str = "o", part: str = "") -> list[Entry]:
    """The entries of an observation in the order of `gymnasium.spaces.flatten`; what is no Box is fixed.

    Args:
        space: the space.
        name: the beginning of their names.
        part: the part that they belong to.

    Raises:
        UserError: if an observation has no fixed number of entries.
    """
    if isinstance(space, spaces.Dict):
        return [entry for key, inner in space.spaces.items() for entry in of_space(inner, str(key), part or str(key))]
    if isinstance(space, spaces.Tuple):
        parts = enumerate(space.spaces)
        return [one for at, inner in parts for one in of_space(inner, f"{name}{at}", part or f"{name}{at}")]
    if not space.is_np_flattenable:
        raise UserError(
            f"its environment observes {type(space).__name__}, which has no fixed number of entries: wrap it"
        )
    if (count := int(spaces.flatdim(space))) > MOST:
        raise UserError(
            f"its observation has {count} entries, at most {MOST} are possible: wrap it, for instance in ResizeObservation"
        )
    if not isinstance(space, spaces.Box):
        return [
            Entry(name=f"{name}_{at}", low=0.0, high=1.0, fixed=True, column=name, part=part) for at in range(count)
        ]
    low, high = (np.asarray(side, np.float64).reshape(-1).tolist() for side in (space.low, space.high))
    return [
        Entry(name=one, low=a, high=b, part=part)
        for one, a, b in zip(_names(name, space.shape), low, high, strict=True)
    ]


def _names(name: str, shape: tuple[int, ...]) -> Iterator[str]:
    """`o0`, `o1` … of a vector, `o0_1` of an array."""
    if not shape:
        yield name
    for place in np.ndindex(shape) if shape else ():
        yield name + "_".join(map(str, place))


def ranged(entries: Sequence[Entry], given: Mapping[str, Any], columns: int) -> list[Entry]:
    """The entries with the given ranges.

    Args:
        entries: the entries.
        given: [low, high] by name: of entries that have these names; or of all entries, or all that are not fixed, in order; or,
            of an array, of the columns of its last axis, which every row has.
        columns: size of that axis; 0 if there is none.

    Raises:
        UserError: if it is neither, or a range is none.
    """
    ranges = {name: _range(name, value) for name, value in given.items()}
    if all(any(entry.called(name) for entry in entries) for name in ranges):
        return [
            _with(entry, next((ends for name, ends in ranges.items() if entry.called(name)), None)) for entry in entries
        ]
    listed = list(ranges.items())
    free = [entry for entry in entries if not entry.fixed]
    if len(listed) in (len(entries), len(free)):
        renamed = iter(listed)
        every = len(listed) == len(entries)
        return [_renamed(entry, *next(renamed)) if every or not entry.fixed else entry for entry in entries]
    if columns and len(listed) == columns:
        found = []
        for place, entry in enumerate(entries):
            name, ends = listed[place % columns]
            found.append(replace(entry, name=f"{name}{place // columns}", column=name, low=ends[0], high=ends[1]))
        return found
    strange = next(name for name in ranges if not any(entry.called(name) for entry in entries))
    each = f" or all {columns} columns" if columns else ""
    raise UserError(
        f"world.features names {strange!r}, which the observation does not have: it has {some(entries)}; name some of these, or "
        f"all {len(entries)} entries{each} in order (got {len(listed)})"
    )


def _renamed(entry: Entry, name: str, ends: tuple[float, float]) -> Entry:
    return replace(entry, name=name, column="", low=ends[0], high=ends[1])


def _with(entry: Entry, ends: tuple[float, float] | None) -> Entry:
    return entry if ends is None else replace(entry, low=ends[0], high=ends[1])


def _range(name: str, value: Any) -> tuple[float, float]:
    ends = frozen(value)
    fits = isinstance(ends, tuple) and len(ends) == 2 and all(_is_number(end) for end in ends)
    if not (fits and ends[0] < ends[1]):
        raise UserError(
            f"world.features: the range of {name} is [low, high], for instance {{{name}: [-1, 1]}}, got {written(value)}"
        )
    return float(ends[0]), float(ends[1])


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def told(entries: Sequence[Entry], option: str, given: Mapping[str, Any], attribute: str) -> list[Entry]:
    """The entries with a value by name in one attribute.

    Raises:
        UserError: if there is no entry of this name, or a value is not allowed.
    """
    for name, value in given.items():
        if not any(entry.called(name) for entry in entries):
            raise UserError(
                f"world.{option} names {name!r}, which the observation does not have: it has {some(entries)}"
            )
        if attribute == "floor" and not (_is_number(value) and value >= 0):
            raise UserError(f"world.{option}: the floor of {name} is a number of at least 0, got {written(value)}")
    return [
        replace(
            entry, **{attribute: next((given[name] for name in given if entry.called(name)), getattr(entry, attribute))}
        )
        for entry in entries
    ]


def features_of(entries: Sequence[Entry]) -> Features:
    """The features of these entries.

    Raises:
        UserError: if an entry has no range, or two have one name. What nobody may change needs one, too: values outside are
            clipped, also for the victim.
    """
    if unknown := [entry for entry in entries if not entry.known]:
        # Of a kind of entries one range is enough.
        names = list(dict.fromkeys(entry.column or entry.name for entry in unknown))
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        shown = ", ".join([f"{name}: [-1, 1]" for name in names[:2]] + ["…"] * (len(names) > 2))
        raise UserError(
            f"the range of {', '.join(names[:3])}{more} is not known: attacks are limited by it, and values outside are clipped. "
            f"Write world.features={{{shown}}} with the range of each sensor"
        )
    names = [entry.name for entry in entries]
    if twice := [name for name in names if names.count(name) > 1][:1] if len(set(names)) < len(names) else []:
        raise UserError(
            f"two entries of the observation have the name {twice[0]!r}: give other names in world.features"
        )
    present = tuple(entry.present for entry in entries)
    return Features(
        names=tuple(names),
        low=tuple(entry.low for entry in entries),
        high=tuple(entry.high for entry in entries),
        units=tuple(entry.unit for entry in entries),
        floors=tuple(entry.floor for entry in entries),
        fixed=tuple(entry.name for entry in entries if entry.fixed),
        present=present if max(present) >= 0 else (),
    )


def some(entries: Sequence[Entry], count: int = 8) -> str:
    """The names of the first entries."""
    names = list(dict.fromkeys(entry.column or entry.name for entry in entries))
    return ", ".join(names[:count]) + (", …" if len(names) > count else "")
