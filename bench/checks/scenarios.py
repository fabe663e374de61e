"""The rules for worlds of any track: axes, grids and facts."""

from __future__ import annotations

import json
import keyword
import pickle
from collections.abc import Mapping

from cavbench.checks.check import BrokenRuleError, Check, Suite, one_line, require
from cavbench.core import registry
from cavbench.core.contracts import Facts, World
from cavbench.core.registry import KINDS
from cavbench.errors import UserError
from cavbench.scenarios import Axes, Axis, Cell, Grid

TAKEN = (*KINDS, "threat", "grid", "episodes", "seeds", "workers", "out", "record", "reference")
"""Keys of `bench run`, which cannot be names of axes."""


class ScenarioSuite(Suite):
    """Checks of a `World` of any track."""

    component: World

    def checks(self) -> Mapping[str, Check]:
        return {"axes": self.describes_its_axes, "grids": self.has_a_grid, "facts": self.publishes_facts}

    def describes_its_axes(self) -> str:
        """Every axis has a valid name, a meaning, and a default that it allows."""
        axes = getattr(self.component, "axes", None)
        require(isinstance(axes, Axes), "declare the axes of its cells: axes: ClassVar[Axes] = Axes((Axis(...),))")
        assert isinstance(axes, Axes)
        require(len(axes.axes) > 0, "axes is empty: a world needs at least one axis")
        require(len(set(axes)) == len(axes.axes), "two axes have the same name: rename one")
        for axis in axes.values():
            _check_axis(axis)
        return ", ".join(axes)

    def has_a_grid(self) -> str:
        """The default grid is installed, and every grid of the world has the world's axes."""
        name = self.subject.name
        if (own := self.component.own_grid()) is not None:
            self._check_values(own)
            return f"from its parameters: {len(own.cells())} cell{'s' if len(own.cells()) > 1 else ''}"
        wanted = getattr(self.component, "grid", None)
        require(isinstance(wanted, str) and wanted, 'name the default grid of a run: grid: ClassVar[str] = "…"')
        try:
            found = registry.grid(str(wanted))
        except UserError as error:
            raise BrokenRuleError(
                f"{one_line(error)}: register its grid as an entry point in {registry.GRIDS}"
            ) from None
        require(
            found.world == name,
            f"the grid {wanted!r} belongs to the world {found.world!r}: name one of this world, or write Grid(world={name!r}, …)",
        )
        grids = registry.grids(name)
        for grid in grids:
            self._check_values(grid)
        cells = len(found.cells())
        return f"{', '.join(grid.name for grid in grids)}; {wanted} has {cells} cell{'s' if cells > 1 else ''}"

    def _check_values(self, grid: Grid) -> None:
        require(
            grid.axes == self.component.axes,
            f"the grid {grid.name!r} has the axes {', '.join(grid.axes)}, but those of the world differ: "
            "use the same Axes object for both",
        )

    def publishes_facts(self) -> None:
        """The facts can be written to records as JSON, and reports can read the axes from there."""
        facts = self.component.facts
        require(isinstance(facts, Facts), f"facts is a {type(facts).__name__}, not a cavbench.core.contracts.Facts")
        require(
            facts.axes == self.component.axes, "facts.axes differ from the world's axes: write Facts(axes=self.axes, …)"
        )
        require(facts.decision_hz >= 0 and facts.max_steps >= 0, "facts.decision_hz and max_steps must not be negative")
        require(
            len(set(facts.actions)) == len(facts.actions), "two actions in facts.actions have the same name: rename one"
        )
        try:
            written = json.loads(json.dumps(facts.written()))
        except (TypeError, ValueError) as error:
            raise BrokenRuleError(f"facts.written() must contain plain JSON values only: {one_line(error)}") from None
        try:
            read = Axes.read(written["axes"])
        except (KeyError, ValueError):
            raise BrokenRuleError("facts.written() must contain the axes: start with super().written()") from None
        require(
            read == facts.axes, "the axes in facts.written() differ from the world's: do not change the entry `axes`"
        )
        require(
            pickle.loads(pickle.dumps(facts)) == facts,
            "a pickled copy of its facts is not equal to them: use plain values",
        )


def _check_axis(axis: Axis) -> None:
    """Raise BrokenRuleError unless an axis can be used on the command line and explained in reports."""
    require(
        axis.name.isidentifier() and not keyword.iskeyword(axis.name),
        f"the axis {axis.name!r} cannot be written as NAME=VALUE: use letters, digits and _",
    )
    require(axis.name not in TAKEN, f"the axis {axis.name!r} has the name of an option of `bench run`: rename it")
    require(axis.meaning.strip(), f"the axis {axis.name!r} has no meaning: add a short description")
    for value in (*axis.choices, *(() if axis.default is None else (axis.default,))):
        try:
            axis.checked(value)
        except ValueError as error:
            raise BrokenRuleError(f"the axis {axis.name!r} does not allow its own value: {one_line(error)}") from None


def first_cell(world: World) -> Cell:
    """The first cell of the default grid of a world.

    Raises:
        UserError: if the grid is not installed.
    """
    return registry.grid_of(world).cells()[0]
