"""The module `cavbench`: what `bench` offers to Python, under the name of the pip package.

Importing it fails with one line if a user's file shadows one of its packages.
"""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Loaded from its file, because Python may find a user's `bench.py` as `bench`.
runpy.run_path(str(Path(__file__).with_name("bench") / "shadow.py"))["check"]("bench")

import bench  # noqa: E402
from bench import __version__  # noqa: E402

if TYPE_CHECKING:
    from bench import UserError, component, gym, load, score

__all__ = ["UserError", "__version__", "component", "gym", "load", "main", "score"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(bench, name)
    raise AttributeError(f"module 'cavbench' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__


def main() -> None:
    """The command `bench`."""
    from bench.cli.ending import ended
    from bench.cli.main import main as command

    ended(command)
