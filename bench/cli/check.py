"""`bench check`: runs the checks of a component, and prints one line for each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table
from rich.text import Text

from cavbench import documents
from cavbench.cli.listing import heading
from cavbench.cli.words import split
from cavbench.core import registry
from cavbench.core.registry import Kind
from cavbench.errors import UserError, short

if TYPE_CHECKING:
    from cavbench.checks.check import Outcome

TRIED_WITH = ("victim", "world")
"""Keys that choose the victim and the world to check a component with."""
MARKS = {
    "pass": ("✓", "green"),
    "fail": ("✗ fix", "bold red"),
    "skip": ("– skipped", "dim"),
    "doubt": ("? look", "yellow"),
}


def print_checks(name: str, words: Sequence[str], console: Console, *, as_json: bool = False) -> int:
    """Run the checks of every component of this name, print them, and return 1 if any failed, otherwise 0.

    Args:
        name: of the component.
        words: its parameters, and what to check it with.
        console: console to print to.
        as_json: print one document (`cavbench.documents`) instead.

    Raises:
        UserError: if no component has the name, its plug-in is broken, or an option cannot be parsed.
    """
    from cavbench.checks import examine
    from cavbench.run.process import settle

    settle()
    for word in words:
        _read(word)
    _, given = split(words, (), names=0)
    kinds = registry.kinds_of(name)
    if strange := [key for key in given if key not in TRIED_WITH and key.partition(".")[0] not in kinds]:
        known = [*(f"{kind}.…" for kind in kinds), *TRIED_WITH]
        raise UserError(registry.unknown(f"key {strange[0]!r}", strange[0], known))
    found: dict[Kind, list[Outcome]] = {}
    for kind in kinds:
        values = {key.partition(".")[2]: value for key, value in given.items() if key.startswith(f"{kind}.")}
        if not as_json:
            console.print(heading(kind, name))
        with nullcontext() if as_json else console.status("checking"):
            tried_with = {key: given.get(key, "") for key in TRIED_WITH}
            found[kind] = list(examine(kind, name, values, **tried_with))
        if not as_json:
            _print(found[kind], console)
    failed = any(outcome.status == "fail" for outcomes in found.values() for outcome in outcomes)
    if as_json:
        components = [{"kind": kind, "outcomes": list(map(asdict, outcomes))} for kind, outcomes in found.items()]
        documents.show("check", {"name": name, "passed": not failed, "components": components})
    return int(failed)


def _print(outcomes: Sequence[Outcome], console: Console) -> None:
    console.print(_table(outcomes))
    counts = Counter(outcome.status for outcome in outcomes)
    look = f"{counts['doubt']} to look at, " if counts["doubt"] else ""
    summary = f"{counts['pass']} passed, {counts['fail']} to fix, {look}{counts['skip']} skipped\n"
    console.print(Text(summary, style="bold red" if counts["fail"] else "green"))


def _table(outcomes: Sequence[Outcome]) -> Table:
    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(ratio=1)
    for outcome in outcomes:
        mark, style = MARKS[outcome.status]
        text = Text(outcome.text, style="" if outcome.status in ("fail", "doubt") else "dim")
        table.add_row(outcome.check, Text(mark, style=style), text)
    return table


def _read(word: str) -> None:
    key, equals, value = word.partition("=")
    if not (equals and value and (key in TRIED_WITH or "." in key)):
        raise UserError(
            f"cannot read {short(word)!r}: write, for instance, attack.steps=50 to set a parameter, victim=NAME to choose the "
            "victim of a defence, or world=NAME to choose the world"
        )
