"""Scenarios: the axes of a world, the cells they span, named grids of cells, and blocks of scenario seeds."""

from cavbench.scenarios.axes import Axes, Axis, Cell, Value
from cavbench.scenarios.grid import Grid, SeedBlock

__all__ = ["Axes", "Axis", "Cell", "Grid", "SeedBlock", "Value"]
