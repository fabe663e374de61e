"""Parameters of a world from gymnasium that become objects: axes and features. Records hold what was given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from cavbench.core.settings import Settings, written
from cavbench.driving.features import Features
from cavbench.errors import UserError
from cavbench.scenarios import Axes, Axis, Grid, Value

EPISODES = 20
"""Scenarios in each cell, unless the user gives another number."""
TASK = "task"
"""The axis of a world without axes: its only cell is the environment."""


class GivenAxes(Axes):
    """Axes of the values that a user gave by name; equal to the same axes that were declared."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Axes) and self.axes == other.axes

    def __hash__(self) -> int:
        return hash(self.axes)

    @property
    def given_parameter(self) -> Settings | None:
        """What was given; None if nothing was."""
        values = {name: list(axis.choices) for name, axis in self.items() if name != TASK}
        return Settings(values) if values else None

    def __str__(self) -> str:
        return str(self.given_parameter)


class GivenFeatures(Features):
    """Features whose ranges a user gave by name; None if he gave none."""

    @property
    def given_parameter(self) -> Settings | None:
        """What was given."""
        found: Settings | None = vars(self).get("_given")
        return found

    @classmethod
    def of(cls, features: Features, given: Settings | None) -> GivenFeatures:
        """The same features, which say that they were made from `given`."""
        made = cls(**vars(features))
        object.__setattr__(made, "_given", given)
        return made


def mapping(option: str, value: Any) -> Settings | None:
    """A parameter that is a mapping.

    Raises:
        ValueError: if it is none.
    """
    if value is None or isinstance(value, Settings):
        return value
    if not isinstance(value, Mapping):
        raise ValueError(f"{option} is a mapping such as {{name: value}}, got {written(value)}")
    return Settings(value)


def axes_of(given: Settings | None, name: str) -> GivenAxes:
    """The axes of a world: one for each given name.

    Args:
        given: the values on each axis.
        name: the environment.

    Raises:
        ValueError: if a value is none of an axis.
    """
    if not given:
        return GivenAxes((Axis(name=TASK, kind="str", meaning="the environment", choices=(name,), default=name),))
    return GivenAxes(tuple(_axis(axis, values) for axis, values in given.items()))


def _axis(name: str, values: Any) -> Axis:
    listed: Sequence[Any] = values if isinstance(values, tuple) else (values,)
    kinds = {bool: "", int: "int", float: "float", str: "str"}
    found = {kinds.get(type(value), "") for value in listed}
    kind = "float" if found == {"int", "float"} else next(iter(found)) if len(found) == 1 else ""
    if not listed or not kind or not name.isidentifier():
        raise ValueError(
            f"axes takes numbers or texts by the name of a setting, for instance {{lanes_count: [3, 4]}}, got {name}: "
            f"{written(values)}"
        )
    chosen: tuple[Value, ...] = tuple(float(value) for value in listed) if kind == "float" else tuple(listed)
    if len(set(chosen)) < len(chosen):
        raise ValueError(f"axes: {name} has a value twice: {written(values)}")
    return Axis(name=name, kind=kind, meaning=f"{name} of the environment", choices=chosen)  # type: ignore[arg-type]


def grid_of(axes: GivenAxes, world: str, name: str) -> Grid:
    """All combinations of the values on the axes."""
    return Grid(
        name=name,
        world=world,
        axes=axes,
        values={key: axis.choices for key, axis in axes.items()},
        episodes=EPISODES,
        training_seeds=1,
    )


def without_units(features: Features) -> Features:
    """Features whose names of units are texts.

    Raises:
        UserError: if one is not.
    """
    if strange := [unit for unit in features.units if not isinstance(unit, str)]:
        raise UserError(f"world.units: a unit is a text such as m/s, got {written(strange[0])}")
    return features
