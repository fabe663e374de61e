"""The last part of `bench run --help`: every option with its default, the axes of every world, and the suites of attacks."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

from rich.padding import Padding
from rich.table import Table
from rich.text import Text
from typer.core import TyperCommand

from cavbench.terminal import Console

COMPONENTS = {
    "attack": ("none", "Attacks, or a suite such as standard: bench list attack."),
    "defense": ("none", "Defences; NAME+NAME is a chain: bench list defense."),
    "victim": ("dqn", "Policies or detectors: bench list victim."),
    "world": ("the track's", "World to drive in: bench list world."),
}
THREAT = {
    "norm": ("relative; patch", "Perturbation set: relative or linf (drivers), patch (detectors)."),
    "budget": ("0.1; 0.5", "Size of the perturbation set."),
    "access": ("gradients", "oblivious, decisions, scores, gradients or dynamics."),
    "queries": ("1000; 20000", "Most evaluations of the victim: per step; per patch."),
    "share": ("1", "Share of the frames that may be attacked (drivers)."),
}
"""Defaults of drivers, then of detectors where they differ. Reading them from the tracks would import torch."""


def settings(schema: type[Any], prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Name, default and meaning of every field of a dataclass of options; of nested ones as `ray.address`."""
    for item in fields(schema):
        factory: Any = item.default_factory
        if is_dataclass(factory):
            yield from settings(factory, f"{prefix}{item.name}.")  # type: ignore[arg-type]
        else:
            yield f"{prefix}{item.name}", item.metadata["default"], item.metadata["meaning"]


def _table(rows: list[tuple[str, str, str]]) -> Table:
    made = Table.grid(padding=(0, 2, 0, 0))
    made.add_column(no_wrap=True, style="bold cyan")
    made.add_column(style="dim")
    made.add_column()
    for name, default, meaning in rows:
        made.add_row(name, default, meaning)
    return made


class RunHelp(TyperCommand):
    """A command whose help ends with all options of `bench run`, the axes of the installed worlds and the suites of attacks."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        from cavbench.core import registry, suites
        from cavbench.core.track import tracks
        from cavbench.run.options import RunOptions

        super().format_help(ctx, formatter)
        console = Console()
        rows = [(kind, default, meaning) for kind, (default, meaning) in COMPONENTS.items()]
        rows += [("KIND.PARAMETER", "", "A parameter of a component: bench list NAME.")]
        rows += [(f"threat.{name}", default, meaning) for name, (default, meaning) in THREAT.items()]
        rows += [
            (
                f"threat.{name}.…",
                "none",
                f"{inspect.cleandoc(kind.__doc__ or '').splitlines()[0]} bench help threat.{name}",
            )
            for track in tracks()
            for name, kind in track.sets.items()
        ]
        rows += settings(RunOptions)
        _print(console, "Every KEY=VALUE, with its default", rows)
        worlds = {grid.world: grid for grid in registry.all_grids()}
        for world, grid in sorted(worlds.items()):
            axes = [(axis.name, axis.allowed, axis.meaning) for axis in grid.axes.values()]
            _print(console, f"Axes of world={world}; the default is every value of the grid", axes)
        found = [
            (f"attack={name}", "", f"{len(suite.members)} attacks on victims of the {suite.track} track")
            for name in suites.names()
            for suite in [suites.suite(name)]
        ]
        _print(console, "Suites of attacks", found)


class TrainHelp(TyperCommand):
    """A command whose help ends with all options of `bench train`."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        from cavbench.run.options import TrainOptions

        super().format_help(ctx, formatter)
        rows = [
            ("victim", "dqn", "Victim to train."),
            ("defense", "none", "Defence to train with the victim: bench list defense."),
            ("attack", "none", "Attack to train against the victim, if it learns: bench list attack."),
            ("world", "the track's", "World to train in."),
            ("KIND.PARAMETER", "", "A parameter of a component: bench list NAME."),
        ]
        _print(Console(), "Every KEY=VALUE, with its default", [*rows, *settings(TrainOptions)])


def _print(console: Console, title: str, rows: list[tuple[str, str, str]]) -> None:
    console.print(Text(f" {title}", style="bold"))
    console.print(Padding(_table(rows), (0, 0, 1, 2)), highlight=False)
