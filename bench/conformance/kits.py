"""What `bench check` and `bench new` know of a track: its kit, found by the entry point `cavbench.kits`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from bench.conformance.check import Subject, Suite
from bench.errors import UserError
from bench.plugins import registry
from bench.plugins.registry import Kind

KITS = "cavbench.kits"
Suites = Callable[[Subject], Iterable[Suite]]
"""Makes the suites that a component has to pass; it may raise `NotApplicableError`."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """What the author of a new component types first.

    Args:
        run: the command that scores it on a small part of the grid; `{name}` stands for its name.
        setting: one of its parameters with another value than the default.
    """

    run: str
    setting: str


@dataclass(frozen=True, kw_only=True)
class Kit:
    """The suites and the templates of a track. Importing it must be quick: no torch.

    Args:
        suites: by kind of component.
        starts: by kind of which there is a template.
        package: whose folder `templates` has KIND.py.tmpl and test_KIND.py.tmpl for each of them.
    """

    suites: Mapping[Kind, Suites]
    starts: Mapping[Kind, Start]
    package: str


def kits() -> list[str]:
    """The names of the tracks that have a kit."""
    return list(registry.entries(KITS))


def kit(track: str) -> Kit | None:
    """The kit of a track; None where it has none.

    Raises:
        UserError: if two packages ship one, it cannot be imported, or its entry point names something else.
    """
    if track not in kits():
        return None
    found = registry.resolve(KITS, track, "kit")
    if not isinstance(found, Kit):
        raise UserError(f"kit {track!r} is not a bench.conformance.kits.Kit")
    return found
