"""What a command does in its first second, before it imports torch: it refuses unknown names, and shows that it works."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

from cavbench.cli.terminal import Console
from cavbench.core.names import split


def check_names(words: Sequence[str], settings: str) -> None:
    """Refuse keys and names of components that nothing has.

    Args:
        words: the options, as typed.
        settings: the options of the command that choose no component: `RunOptions` or `TrainOptions`.

    Raises:
        UserError: if there is one.
    """
    from cavbench.core import registry, suites
    from cavbench.core.options import Options
    from cavbench.run import options

    axes = list(dict.fromkeys(axis for grid in registry.all_grids() for axis in grid.axes))
    run = settings == "RunOptions"
    given = Options(words, kinds=registry.KINDS, settings=getattr(options, settings), axes=axes if run else [])
    for kind in registry.KINDS:
        for name in given.values.get(kind, ()):
            # Hydra's grammar escapes the colon of NAME:CHOICE.
            plain = name.replace("\\:", ":").partition(":")[0]
            links = split(plain) if kind == "defense" else [plain]
            known = [*registry.names(kind), *(suites.names() if run and kind == "attack" else [])]
            for link in links:
                if link not in known:
                    registry.find(registry.GROUPS[kind], link, kind)


def starting(console: Console) -> AbstractContextManager[object]:
    """Shows that the command is starting, on a terminal."""
    return console.status("starting", spinner="dots") if console.is_terminal else nullcontext()
