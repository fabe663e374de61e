"""Kits: what `bench check` and `bench new` need of a track, found by the entry point `cavbench.kits`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from cavbench.checks.check import Subject, Suite
from cavbench.core import registry
from cavbench.core.registry import Kind
from cavbench.errors import UserError

KITS = "cavbench.kits"
Suites = Callable[[Subject], Iterable[Suite]]
"""Creates the suites for a component; may raise `NotApplicableError`."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """First commands for the author of a new component.

    Args:
        run: command that scores it on a small part of the grid; `{name}` stands for its name.
        setting: one of its parameters with a value other than the default.
    """

    run: str
    setting: str


@dataclass(frozen=True, kw_only=True)
class Home:
    """Where the built-in components of a kind stand in a checkout of cavbench.

    Args:
        folder: folder of their code.
        package: the package that this folder is.
        tests: folder of their tests.
    """

    folder: str
    package: str
    tests: str


@dataclass(frozen=True, kw_only=True)
class Kit:
    """The suites and the templates of a track. Importing it must be quick: no torch.

    Args:
        suites: suites by kind of component.
        starts: first commands by kind; each of these kinds has a template.
        package: package whose folder `templates` contains KIND.py.tmpl and test_KIND.py.tmpl for these kinds, and KIND.md.tmpl
            for those with a home.
        homes: where built-in components stand, by kind; for the tracks of cavbench itself.
    """

    suites: Mapping[Kind, Suites]
    starts: Mapping[Kind, Start]
    package: str
    homes: Mapping[Kind, Home] = field(default_factory=dict)


def kits() -> list[str]:
    """The names of the tracks that have a kit."""
    return list(registry.entries(KITS))


def kit(track: str) -> Kit | None:
    """The kit of a track; None if it has none.

    Raises:
        UserError: if two packages ship one, it cannot be imported, or it is not a `Kit`.
    """
    if track not in kits():
        return None
    found = registry.resolve(KITS, track, "kit")
    if not isinstance(found, Kit):
        raise UserError(f"kit {track!r} is not a cavbench.checks.kits.Kit")
    return found
