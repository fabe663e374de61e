"""The last part of `bench run --help`: the axes of every world, read from its grids, and the suites of attacks."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand


class AxesHelp(TyperCommand):
    """A command whose help ends with the axes of the installed worlds and the suites of attacks."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        from bench.plugins import registry, suites

        worlds = {grid.world: grid for grid in registry.all_grids()}
        lines = ["Axes of the worlds; choose values with comma lists:"]
        for world, grid in sorted(worlds.items()):
            axes = (f"{axis.name} ({axis.meaning}): {axis.allowed}" for axis in grid.axes.values())
            lines.append(f"{world}. {'; '.join(axes)}.")
        for name in suites.names():
            suite = suites.suite(name)
            versions = f" (now {suite.name})" if suite.name != name else ""
            lines.append(
                f"attack={name}{versions} is a suite of {len(suite.members)} attacks for the {suite.track} track."
            )
        self.epilog = "\n\n".join(lines)
        super().format_help(ctx, formatter)
