"""The axes of a world, and cells: one value on each axis."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

Value = int | float | str
KINDS: dict[str, type] = {"int": int, "float": float, "str": str}


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One dimension of a world's cells, such as the number of lanes, the density of traffic or the weather.

    Args:
        name: name on the command line and in records, for instance `lanes`; a Python identifier.
        kind: type of its values.
        meaning: short description.
        unit: unit of its values; empty for names and counts.
        low, high: smallest and largest allowed number.
        above: exclusive lower bound of a number.
        choices: allowed values, for names in the order of tables. Empty: any value within the bounds.
        default: value of cells that leave it out; None if every cell must give one.
        perceptual: whether it changes only what is observed, as fog does. Input-independent policies are driven at its first
            value only.
        unseen: whether it changes nothing that a camera sees, as the speed of a car does: detectors look once at frames of cells
            that differ in it alone.
    """

    name: str
    kind: Literal["int", "float", "str"]
    meaning: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    choices: tuple[Value, ...] = ()
    default: Value | None = None
    perceptual: bool = False
    unseen: bool = False

    def checked(self, value: Value) -> Value:
        """Convert a value to the type of the axis.

        Raises:
            ValueError: in one line, if the value is not allowed.
        """
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if self.kind == "str":
            fits = isinstance(value, str)
        else:
            fits = number and (self.kind == "float" or value == int(value))
        found = KINDS[self.kind](value) if fits else value
        if not fits or not self._holds(found):
            raise ValueError(f"{self.name} must be {self.allowed}, got {value}")
        return found

    def read(self, text: str) -> Value:
        """Parse a value from the command line.

        Raises:
            ValueError: in one line, if the value cannot be parsed or is not allowed.
        """
        try:
            return self.checked(KINDS[self.kind](text))
        except ValueError:
            raise ValueError(f"{self.name} must be {self.allowed}, got {text}") from None

    @property
    def allowed(self) -> str:
        """The allowed values as text."""
        if self.choices:
            return f"one of {', '.join(map(written, self.choices))}"
        noun = {"int": "a whole number", "float": "a number", "str": "a name"}[self.kind]
        if -math.inf < self.low and self.high < math.inf:
            return f"{noun} between {self.low:g} and {self.high:g}"
        low = f"of at least {self.low:g}" if self.low > -math.inf else ""
        low = f"above {self.above:g}" if self.above > -math.inf else low
        high = f"at most {self.high:g}" if self.high < math.inf else ""
        return " ".join([noun, " and ".join(filter(None, (low, high)))]).strip()

    def _holds(self, value: Value) -> bool:
        if self.choices:
            return value in self.choices
        return isinstance(value, str) or (self.low <= value <= self.high and value > self.above)

    def place(self, value: Value) -> tuple[float, str]:
        """Sort key of a value: numbers by size, names in the order of `choices`."""
        if isinstance(value, str):
            return (self.choices.index(value) if value in self.choices else len(self.choices), value)
        return (float(value), "")


class Cell(Mapping[str, Value]):
    """One cell of a grid: a value on each axis of a world, without a seed. `cell.lanes` is `cell["lanes"]`."""

    __slots__ = ("_hash", "_values")
    _values: dict[str, Value]
    _hash: int

    def __init__(self, **values: Value) -> None:
        object.__setattr__(self, "_values", values)
        object.__setattr__(self, "_hash", hash(frozenset(values.items())))

    def __getitem__(self, name: str) -> Value:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __getattr__(self, name: str) -> Any:
        try:
            return self._values[name]
        except KeyError:
            raise AttributeError(f"the cell {self} has no axis {name!r}") from None

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError("a cell is immutable: create another one with `replaced`")

    def __eq__(self, other: object) -> bool:
        # Reports compare hundreds of thousands of cells; what `Mapping` does takes twenty times as long.
        if isinstance(other, Cell):
            return self is other or (self._hash == other._hash and self._values == other._values)
        return super().__eq__(other)

    def __hash__(self) -> int:
        return self._hash

    def __reduce__(self) -> tuple[Any, ...]:
        return _made, (self._values,)

    def __repr__(self) -> str:
        return f"Cell({', '.join(f'{name}={value!r}' for name, value in self.items())})"

    def __str__(self) -> str:
        return ", ".join(value if isinstance(value, str) else f"{name} {value:g}" for name, value in self.items())

    def replaced(self, **values: Value) -> Cell:
        """The same cell with other values on some axes."""
        return Cell(**{**self._values, **values})


def _made(values: Mapping[str, Value]) -> Cell:
    return Cell(**values)


@dataclass(frozen=True)
class Axes(Mapping[str, Axis]):
    """The axes of a world, in the order of its cells."""

    axes: tuple[Axis, ...]
    _by_name: dict[str, Axis] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_by_name", {axis.name: axis for axis in self.axes})

    def __getitem__(self, name: str) -> Axis:
        return self._by_name[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self.axes)

    @classmethod
    def read(cls, written: Sequence[Mapping[str, Any]]) -> Axes:
        """The axes in records (`cavbench.core.contracts.Facts.written`).

        Raises:
            ValueError: if `written` does not describe axes.
        """
        try:
            return cls(tuple(Axis(**{**axis, "choices": tuple(axis.get("choices", ()))}) for axis in written))
        except (TypeError, AttributeError):
            raise ValueError("not axes: each needs a name, a kind and a meaning, and no unknown property") from None

    def cell(self, **values: Value) -> Cell:
        """A cell with a checked value on every axis; missing values take the default.

        Raises:
            ValueError: in one line, if an axis is unknown, or a value is missing or not allowed.
        """
        if unknown := [name for name in values if name not in self]:
            raise ValueError(f"unknown axis {unknown[0]!r}; known: {', '.join(self)}")
        found = {}
        for axis in self.axes:
            value = values.get(axis.name, axis.default)
            if value is None:
                raise ValueError(f"a cell needs a value for {axis.name}: {axis.allowed}")
            found[axis.name] = axis.checked(value)
        return Cell(**found)

    def unperceived(self, cell: Cell) -> Cell:
        """The cell with every perceptual axis at its first value, in which input-independent policies are driven."""
        first = {axis.name: axis.choices[0] for axis in self.axes if axis.perceptual and axis.choices}
        return cell.replaced(**first)

    def looked_at(self, cell: Cell) -> Cell:
        """The cell with every unseen axis at its default: equal for cells with the same frames."""
        usual = {axis.name: axis.default for axis in self.axes if axis.unseen and axis.default is not None}
        return cell.replaced(**usual)

    def place(self, cell: Cell) -> tuple[tuple[float, str], ...]:
        """Sort key of a cell: perceptual axes first, so that tables are grouped by weather."""
        ordered = sorted(self.axes, key=lambda axis: not axis.perceptual)
        return tuple(axis.place(cell[axis.name]) for axis in ordered)


def written(value: Value) -> str:
    """A value as text, for tables and commands."""
    return value if isinstance(value, str) else f"{value:g}"
