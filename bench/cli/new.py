"""`bench new`: creates a component that works, and prints the next commands."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.text import Text

from cavbench.checks import builtin, scaffold
from cavbench.cli.words import split

KEYS = ("track", "out")


def print_new(kind: str, name: str, words: Sequence[str], console: Console, *, built_in: bool = False) -> None:
    """Write a plug-in, or a built-in component, and print the next commands.

    Raises:
        UserError: if an option cannot be parsed, or the files cannot be written.
    """
    _, given = split(words, KEYS, names=0)
    track, out = given.get("track") or scaffold.default_track(), given.get("out")
    folder = Path(out).expanduser() if out else None
    if built_in:
        made, lines = _built_in(kind, name, track, folder)
    else:
        made, lines = _plug_in(kind, name, track, folder)
    console.print(Text(f"Created {made}. Next, in the environment of cavbench:"), soft_wrap=True)
    for command, meaning in lines.items():
        console.print(Text.assemble("\n    ", (command, "bold"), "\n    ", (meaning, "dim")), soft_wrap=True)


def _plug_in(kind: str, name: str, track: str, folder: Path | None) -> tuple[str, dict[str, str]]:
    """What was created, and the next commands with their meanings."""
    folder = scaffold.write(kind, name, track=track, folder=folder)
    return str(folder), {
        f"pip install -e '{folder}[test]'": "installs it; your later edits take effect at once",
        f"bench check {name}": "checks that it follows the rules",
        f"python -m pytest {folder}": "runs its tests",
        scaffold.first_run(kind, name, track): "scores it on a part of the grid",
    }


def _built_in(kind: str, name: str, track: str, folder: Path | None) -> tuple[str, dict[str, str]]:
    """What was created, and the next commands with their meanings."""
    code, project, page, test = builtin.write(kind, name, track=track, folder=folder)
    return f"{code}, {page} and {test}, with an entry in {project}", {
        f"pip install --no-deps -e {project.parent}": "reads the new entry of pyproject.toml",
        f"bench check {name}": "checks that it follows the rules",
        f"python -m pytest {test}": "runs its test",
        "make docs": "builds the site with its page",
        scaffold.first_run(kind, name, track): "scores it on a part of the grid",
    }
