"""`bench render`: the frames of a camera world."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.text import Text

from bench.cli.progress import TrainingProgress
from bench.errors import UserError
from bench.run.config import component


def render(world: str, out: Path | None, console: Console) -> None:
    """Render what is not rendered yet, and say where it is.

    Args:
        world: name of the world.
        out: folder for the frames; None for the world's own.
        console: where to print.

    Raises:
        UserError: if the world has nothing to render, or the renderer is not installed.
    """
    found = component("world", world, {})
    make = getattr(found, "render", None)
    if make is None:
        raise UserError(f"world {world!r} has no camera to render for")
    with TrainingProgress(Console(stderr=True), f"render {world}") as progress:
        try:
            files = make(out, progress)
        except NotImplementedError as error:
            raise UserError(str(error)) from error
    size = sum(file.stat().st_size for file in files) / 1e6
    console.print(Text(f"{len(files)} files, {size:.1f} MB, in {files[0].parent}"), soft_wrap=True)
