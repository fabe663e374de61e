"""`bench render`: renders the frames of a camera world."""

from __future__ import annotations

from pathlib import Path

from rich.text import Text

from cavbench.cli.progress import TrainingProgress
from cavbench.errors import UserError
from cavbench.files import check_folder
from cavbench.run.config import component
from cavbench.terminal import Console


def render(world: str, out: Path | None, console: Console) -> None:
    """Render the missing frames, and print where they are.

    Args:
        world: name of the world.
        out: folder for the frames; None for the default of the world.
        console: console to print to.

    Raises:
        UserError: if the world has no frames to render, or the renderer is not installed.
    """
    make = getattr(component("world", world, {}), "render", None)
    if make is None:
        raise UserError(f"world {world!r} has no frames to render; choose a camera world")
    if out is not None:
        check_folder(out, "the folder")
    with TrainingProgress(Console(stderr=True), f"render {world}") as progress:
        try:
            files = make(out, progress)
        except NotImplementedError as error:
            raise UserError(str(error)) from error
    size = sum(file.stat().st_size for file in files) / 1e6
    console.print(Text(f"{len(files)} files, {size:.1f} MB, in {files[0].parent}"), soft_wrap=True)
