"""The module `cavbench`: importing it fails with one line if a user's file shadows one of its packages."""

from __future__ import annotations

import runpy
from pathlib import Path

# Loaded from its file, because Python may find a user's `bench.py` as `bench`.
runpy.run_path(str(Path(__file__).with_name("bench") / "shadow.py"))["check"]("bench")

from bench import __version__  # noqa: E402

__all__ = ["__version__", "main"]


def main() -> None:
    """The command `bench`."""
    from bench.cli.main import main as command

    command()
