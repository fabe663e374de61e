"""What a command does in its first seconds: it imports torch, and shows that it works."""

from __future__ import annotations

from contextlib import nullcontext

from cavbench.terminal import Console


def start(executor: str = "") -> None:
    """Import torch, which takes seconds; a terminal shows that the command is starting.

    The server of worker processes imports it at the same time.

    What is drawn ends before anything else begins: a component is first imported in a copy of this process, and a copy that
    was made while a terminal is drawn on may hang.

    Args:
        executor: the back end of the run; none for a training.
    """
    if executor == "processes":
        from cavbench.run.server import server

        server()
    console = Console(stderr=True)
    with console.status("starting", spinner="dots") if console.is_terminal else nullcontext():
        import torch  # noqa: F401
