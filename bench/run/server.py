"""The server that worker processes are forked from. Starting it early lets its imports go on beside those of the command."""

from __future__ import annotations

from functools import cache
from multiprocessing.context import BaseContext

from cavbench.core import registry
from cavbench.core.track import track
from cavbench.run.process import context

FIRST, WORKER = "cavbench.run.quick_server", "cavbench.run.worker"
RANGES = "cavbench.envs.highway.world"


@cache
def work_modules() -> tuple[str, ...]:
    """The modules that do the work of the built-in tracks, and those with the ranges of the driving world's features.

    What is imported before any plug-in can be compared with what plug-ins leave of it.
    """
    names = [
        name for name, claims in registry.entries(registry.TRACKS).items() if claims[0].distribution == registry.OWN
    ]
    work = [module for name in names for module in (track(name).work, track(name).preparation) if module]
    return (*work, RANGES)


def server(*modules: str) -> BaseContext:
    """How worker processes are made; the first call starts the server, and does not wait for its imports.

    Args:
        modules: built-in modules that the server imports, too, so that not every worker does.
    """
    return context(FIRST, WORKER, *work_modules(), *modules)
