"""What a command does in its first seconds: it imports torch, and shows that it works."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from contextlib import nullcontext

from cavbench.terminal import Console

OBJECTS = 200_000
"""Objects that a command makes between two looks for garbage. Imports make a million, and leave next to none."""


def start(executor: str = "", modules: Sequence[str] = ()) -> None:
    """Import torch, which takes seconds; a terminal shows that the command is starting.

    The server of worker processes imports it at the same time.

    What is drawn ends before anything else begins: a component is first imported in a copy of this process, and a copy that
    was made while a terminal is drawn on may hang.

    Args:
        executor: the back end of the run; none for a training.
        modules: what the server imports, too: the built-in components of the run.
    """
    # With Python's own 700 objects, a third of the time of the imports goes into looking for garbage.
    gc.set_threshold(OBJECTS, 20, 20)
    if executor == "processes":
        from cavbench.run.server import server

        server(*modules)
    console = Console(stderr=True)
    with console.status("starting", spinner="dots") if console.is_terminal else nullcontext():
        import torch  # noqa: F401
