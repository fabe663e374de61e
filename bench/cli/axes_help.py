"""The last part of `bench run --help`: the axes of every world, read from its grids."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand


class AxesHelp(TyperCommand):
    """A command whose help ends with the axes of the installed worlds."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        from bench.plugins import registry

        worlds = {grid.world: grid for grid in registry.all_grids()}
        lines = ["Axes of the worlds; choose values with comma lists:"]
        for world, grid in sorted(worlds.items()):
            axes = (f"{axis.name} ({axis.meaning}): {axis.allowed}" for axis in grid.axes.values())
            lines.append(f"{world}. {'; '.join(axes)}.")
        self.epilog = "\n\n".join(lines)
        super().format_help(ctx, formatter)
