"""Worlds that each break one rule about their cells, facts or actions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from torchrl.envs import EnvBase
from toy_plugin import ToyEnv, ToyWorld  # type: ignore[import-not-found]

from cavbench.core.contracts import Facts
from cavbench.driving import Control, Driver, DrivingFacts
from cavbench.errors import UserError
from cavbench.scenarios import Axes, Axis, Cell, Grid


def axes(**changes: Any) -> Axes:
    """One axis, `gap`, with some fields changed."""
    return Axes((Axis(**{"name": "gap", "kind": "int", "meaning": "to the car ahead", "unit": "m"} | changes),))


def grid(world: str, of: Axes, value: int = 20) -> Grid:
    """A grid of a single cell."""
    return Grid(name=f"{world}-v1", world=world, axes=of, values={next(iter(of)): (value,)}, episodes=2)


PLAIN = axes()
NAMELESS, TAKEN, DEFAULTED = axes(name="the gap"), axes(name="seeds"), axes(low=10, default=5)
SILENT = axes(meaning="")
GRIDS = {
    "nameless": grid("nameless", NAMELESS),
    "taken": grid("taken", TAKEN),
    "silent": grid("silent", SILENT),
    "defaulted": grid("defaulted", DEFAULTED),
    "otheraxes": grid("otheraxes", axes(unit="km")),
    **{name: grid(name, PLAIN) for name in ("lying", "general", "unwritten", "timeless", "miscounted", "driverless")},
    "choosy": replace(grid("choosy", PLAIN), values={"gap": (20, 30)}),
    "refusing": grid("refusing", PLAIN),
}
(NAMELESS_V1, TAKEN_V1, SILENT_V1, DEFAULTED_V1, OTHERAXES_V1, LYING_V1, GENERAL_V1, UNWRITTEN_V1, TIMELESS_V1,
 MISCOUNTED_V1, DRIVERLESS_V1, CHOOSY_V1, REFUSING_V1) = GRIDS.values()  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Bad(ToyWorld):
    """A world with one axis; its subclasses break one rule each."""

    axes: ClassVar[Axes] = PLAIN


@dataclass(frozen=True, kw_only=True)
class Nameless(Bad):
    """The name of its axis contains a space."""

    axes: ClassVar[Axes] = NAMELESS
    grid: ClassVar[str] = "nameless-v1"


@dataclass(frozen=True, kw_only=True)
class Taken(Bad):
    """Its axis has the name of an option of a run."""

    axes: ClassVar[Axes] = TAKEN
    grid: ClassVar[str] = "taken-v1"


@dataclass(frozen=True, kw_only=True)
class Silent(Bad):
    """Its axis has no meaning."""

    axes: ClassVar[Axes] = SILENT
    grid: ClassVar[str] = "silent-v1"


@dataclass(frozen=True, kw_only=True)
class Defaulted(Bad):
    """The default of its axis is out of bounds."""

    axes: ClassVar[Axes] = DEFAULTED
    grid: ClassVar[str] = "defaulted-v1"


@dataclass(frozen=True, kw_only=True)
class Gridless(Bad):
    """Its grid does not exist."""

    grid: ClassVar[str] = "gridless-v1"


@dataclass(frozen=True, kw_only=True)
class Borrowing(Bad):
    """Its grid belongs to another world."""

    grid: ClassVar[str] = "standard-v2"


@dataclass(frozen=True, kw_only=True)
class Otheraxes(Bad):
    """Its grid has other axes."""

    grid: ClassVar[str] = "otheraxes-v1"


@dataclass(frozen=True, kw_only=True)
class Lying(Bad):
    """Its facts have other axes."""

    grid: ClassVar[str] = "lying-v1"

    @property
    def facts(self) -> DrivingFacts:
        return replace(super().facts, axes=NAMELESS)


@dataclass(frozen=True, kw_only=True)
class General(Bad):
    """Its facts are not of the class of its track."""

    grid: ClassVar[str] = "general-v1"

    @property
    def facts(self) -> Any:
        return Facts(axes=self.axes)


class _Unwritten(DrivingFacts):
    def written(self) -> dict[str, Any]:
        return {"cells": {1, 2}}


@dataclass(frozen=True, kw_only=True)
class Unwritten(Bad):
    """Its facts cannot be written as JSON."""

    grid: ClassVar[str] = "unwritten-v1"

    @property
    def facts(self) -> DrivingFacts:
        return _Unwritten(**vars(super().facts))


@dataclass(frozen=True, kw_only=True)
class Timeless(Bad):
    """Its decision rate is 0."""

    grid: ClassVar[str] = "timeless-v1"

    @property
    def decision_hz(self) -> float:
        return 0.0


@dataclass(frozen=True, kw_only=True)
class Miscounted(Bad):
    """It names three actions, but accepts five."""

    grid: ClassVar[str] = "miscounted-v1"
    actions: ClassVar[tuple[str, ...]] = ("LEFT", "STRAIGHT", "RIGHT")

    def build(self, cells: Sequence[Cell], control: Control) -> EnvBase:
        return ToyEnv(cells, 5 if control.action_type == "discrete" else 0, self.max_steps)


@dataclass(frozen=True, kw_only=True)
class Driverless(Bad):
    """It names a driver that it cannot create."""

    grid: ClassVar[str] = "driverless-v1"
    drivers: ClassVar[tuple[Driver, ...]] = ("agent", "idm")

    def build(self, cells: Sequence[Cell], control: Control) -> EnvBase:
        if control.driver == "idm":
            raise KeyError("idm")
        return super().build(cells, control)


@dataclass(frozen=True, kw_only=True)
class Choosy(Bad):
    """It cannot start one of the cells of its grid."""

    grid: ClassVar[str] = "choosy-v1"

    def build(self, cells: Sequence[Cell], control: Control) -> EnvBase:
        if any(cell.gap > 20 for cell in cells):
            raise ValueError("the gap is too large")
        return super().build(cells, control)


@dataclass(frozen=True, kw_only=True)
class Refusing(Bad):
    """It refuses continuous actions, which is allowed."""

    grid: ClassVar[str] = "refusing-v1"

    def build(self, cells: Sequence[Cell], control: Control) -> EnvBase:
        if control.action_type == "continuous":
            raise UserError("this world has no steering")
        return super().build(cells, control)
