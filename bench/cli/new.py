"""`bench new`: creates a plug-in package that works, and prints the next commands."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.text import Text

from cavbench.checks import scaffold
from cavbench.cli.words import split

KEYS = ("track", "out")


def print_new(kind: str, name: str, words: Sequence[str], console: Console) -> None:
    """Write the package and print the next commands.

    Raises:
        UserError: if an option cannot be parsed, or the package cannot be written.
    """
    _, given = split(words, KEYS, names=0)
    track, out = given.get("track") or scaffold.default_track(), given.get("out")
    folder = scaffold.write(kind, name, track=track, folder=Path(out).expanduser() if out else None)
    console.print(Text(f"Created {folder}. Next, in the environment of cavbench:"), soft_wrap=True)
    lines = {
        f"pip install -e '{folder}[test]'": "installs it; your later edits take effect at once",
        f"bench check {name}": "checks that it follows the rules",
        f"python -m pytest {folder}": "runs its tests",
        scaffold.first_run(kind, name, track): "scores it on a part of the grid",
    }
    for command, meaning in lines.items():
        console.print(Text.assemble("\n    ", (command, "bold"), "\n    ", (meaning, "dim")), soft_wrap=True)
