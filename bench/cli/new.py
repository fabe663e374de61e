"""`bench new`: writes a plug-in package that works, and says what to type next."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.text import Text

from bench.conformance import scaffold
from bench.errors import UserError
from bench.plugins import registry

KEYS = ("track", "out")


def print_new(kind: str, name: str, words: Sequence[str], console: Console) -> None:
    """Write the package and say what is next.

    Raises:
        UserError: if a word cannot be read or the package not be written.
    """
    given: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if key not in KEYS or not (equals and value):
            raise UserError(registry.unknown(f"word {word!r}", key, [f"{known}=…" for known in KEYS]))
        given[key] = value
    track, out = given.get("track") or scaffold.default_track(), given.get("out")
    folder = scaffold.write(kind, name, track=track, folder=Path(out).expanduser() if out else None)
    console.print(Text(f"{folder} is written. Next, in the environment that cavbench is in:"), soft_wrap=True)
    lines = {
        f"pip install -e '{folder}[test]'": "bench finds it from now on, also after you edit it",
        f"bench check {name}": "does it keep the rules?",
        f"python -m pytest {folder}": "its own test",
        scaffold.first_run(kind, name, track): "a first score, on a part of the grid",
    }
    for command, meaning in lines.items():
        console.print(Text.assemble("\n    ", (command, "bold"), "\n    ", (meaning, "dim")), soft_wrap=True)
