"""`bench compare`: what is better and what is worse in one set of results than in another."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from cavbench import documents
from cavbench.core import registry
from cavbench.errors import UserError
from cavbench.terminal import Console

COMPARISONS = "cavbench.comparisons"
"""The entry points of how results are compared, and how that is shown."""


class Compared(Protocol):
    """A comparison (`cavbench.leaderboard.comparisons.versus.Versus`)."""

    @property
    def worse(self) -> Sequence[Any]: ...

    def content(self) -> dict[str, Any]: ...


def print_comparison(
    sources: Sequence[str], console: Console, *, cells: bool = False, as_json: bool = False, as_markdown: bool = False
) -> None:
    """Compare two sources, and print the differences.

    Args:
        sources: the two, as they were typed.
        console: console to print to.
        cells: print every cell, not only those that changed.
        as_json: print one document (`cavbench.documents`).
        as_markdown: print Markdown.

    Raises:
        UserError: if there are not two, one cannot be read, or they cannot be compared.
    """
    if len(sources) != 2:
        raise UserError(
            f"bench compare takes two sources, got {len(sources)}: bench compare A B, for instance results published"
        )
    if as_json and as_markdown:
        raise UserError("--json and --markdown write two formats to one place: choose one")
    found = compared(*sources)
    if as_json:
        documents.show("compare", found.content())
    elif as_markdown:
        sys.stdout.write(markdown(found))
    else:
        registry.resolve(COMPARISONS, "table", "comparison")(found, console, cells=cells)


def compared(first: str | Mapping[str, Any], second: str | Mapping[str, Any], names: Sequence[str] = ()) -> Compared:
    """The comparison of two sources, or of records by track.

    Raises:
        UserError: if one cannot be read, or they cannot be compared.
    """
    found: Compared = registry.resolve(COMPARISONS, "compare", "comparison")(first, second, names)
    return found


def markdown(found: Compared) -> str:
    """A comparison in Markdown."""
    return str(registry.resolve(COMPARISONS, "markdown", "comparison")(found))
