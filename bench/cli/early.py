"""What a command does in its first seconds: it imports torch, and shows that it works."""

from __future__ import annotations

from contextlib import nullcontext

from cavbench.terminal import Console


def start() -> None:
    """Import torch, which takes seconds; a terminal shows that the command is starting.

    What is drawn ends before anything else begins: a component is first imported in a copy of this process, and a copy that
    was made while a terminal is drawn on may hang.
    """
    console = Console(stderr=True)
    with console.status("starting", spinner="dots") if console.is_terminal else nullcontext():
        import torch  # noqa: F401
