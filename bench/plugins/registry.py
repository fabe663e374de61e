"""Names to components, through Python entry points only: a third party's plug-in is found exactly as a built-in is.

Reading names imports no component, so `bench list` is quick; a component's module is imported when it is loaded.
"""

from __future__ import annotations

import contextlib
import difflib
import inspect
from collections.abc import Iterable
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from importlib import metadata
from typing import TYPE_CHECKING, Any, Literal, get_args

from bench import shadow
from bench.errors import UserError, reason
from bench.scenarios import Grid

if TYPE_CHECKING:
    pass

Kind = Literal["attack", "defense", "victim", "world"]
KINDS: tuple[Kind, ...] = get_args(Kind)
GROUPS: dict[Kind, str] = {
    "attack": "cavbench.attacks",
    "defense": "cavbench.defenses",
    "victim": "cavbench.victims",
    "world": "cavbench.worlds",
}
REPORTS, TRACKS, GRIDS = "cavbench.reports", "cavbench.tracks", "cavbench.grids"


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One name in a group of entry points.

    Args:
        name: what the command line calls it.
        target: `module:attribute`.
        distribution: name of the pip package that ships it.
        version: of that package.
    """

    name: str
    target: str
    distribution: str
    version: str

    @property
    def shipped_by(self) -> str:
        """Distribution and version, as records name them."""
        return f"{self.distribution} {self.version}"


@cache
def entries(group: str) -> dict[str, tuple[Entry, ...]]:
    """Every name of an entry-point group, sorted, with all that claim it: more than one is a clash."""
    found: dict[str, set[Entry]] = {}
    for point in metadata.entry_points(group=group):
        distribution, version = (point.dist.name, point.dist.version) if point.dist else ("unknown", "unknown")
        entry = Entry(name=point.name, target=point.value, distribution=distribution, version=version)
        found.setdefault(point.name, set()).add(entry)
    return {name: tuple(sorted(found[name], key=lambda entry: entry.shipped_by)) for name in sorted(found)}


def names(kind: Kind) -> list[str]:
    """The names of all components of a kind, without importing any."""
    return list(entries(GROUPS[kind]))


def kinds_of(name: str) -> list[Kind]:
    """The kinds of component that have this name.

    Raises:
        UserError: if none has.
    """
    kinds = [kind for kind in KINDS if _plain(name) in names(kind)]
    if not kinds:
        raise UserError(
            unknown(f"component {name!r}", name, sorted({known for kind in KINDS for known in names(kind)}))
        )
    return kinds


def on_track(kind: Kind, name: str, track: str) -> str:
    """What a name means on a track: NAME_TRACK where there is such a component, or else the name itself."""
    own = f"{name}_{track}"
    return own if own in entries(GROUPS[kind]) else name


def problem(claims: tuple[Entry, ...]) -> str:
    """What is wrong with a name as far as can be said without importing it; empty if nothing."""
    if len(claims) == 1:
        return ""
    return f"shipped by {' and by '.join(entry.shipped_by for entry in claims)}; uninstall one"


def find(group: str, name: str, noun: str) -> Entry:
    """The entry of a name, or of the NAME of NAME:CHOICE.

    Args:
        group: entry-point group.
        name: of the entry.
        noun: what the error message calls it, for instance `attack`.

    Raises:
        UserError: if there is none, or more than one.
    """
    known = entries(group)
    own = _plain(name)
    if own not in known:
        raise UserError(unknown(f"{noun} {own!r}", own, known))
    if complaint := problem(known[own]):
        raise UserError(f"{noun} {own!r} is {complaint}")
    return known[own][0]


def resolve(group: str, name: str, noun: str) -> Any:
    """The object an entry point names, imported.

    Raises:
        UserError: if there is no such name, or if importing it fails, naming the package that ships it.
    """
    entry = find(group, name, noun)
    point = metadata.EntryPoint(name=name, value=entry.target, group=group)
    try:
        return point.load()
    # A plug-in may fail in any way while it is imported, end the program too, and must not take the others with it.
    except (Exception, SystemExit) as error:
        why = shadow.explanation(point.module, entry.distribution) or reason(error)
        raise UserError(f"{_where(group, name, noun)} cannot be imported: {why}") from error


def declared(kind: Kind, name: str) -> type[Any]:
    """The class that a name, or the NAME of NAME:CHOICE, stands for: a component, or an adapter with `choices`.

    Raises:
        UserError: if the name is unknown or taken twice, or if the plug-in is broken: it cannot be imported, or is
            not derived from a base class of its kind and of a track.
    """
    from bench.plugins import contracts

    component: Any = resolve(GROUPS[kind], name, kind)
    where = _where(GROUPS[kind], name, kind)
    base = getattr(contracts, kind.capitalize())
    if not (inspect.isclass(component) and issubclass(component, base)):
        raise UserError(f"{where} is not a subclass of bench.plugins.contracts.{base.__name__}")
    known: type[Any] = component
    if not known.tracks():
        raise UserError(
            f"{where} is of no track: derive it from a base class of one, as there are in bench.driving and bench.detection"
        )
    return known


def grid(name: str) -> Grid:
    """The grid of this name.

    Raises:
        UserError: if there is none, or if what its entry point names is no grid.
    """
    found = resolve(GRIDS, name, "grid")
    if not isinstance(found, Grid) or found.name != name:
        raise UserError(f"{_where(GRIDS, name, 'grid')} is not a bench.scenarios.Grid of that name")
    return found


def all_grids() -> list[Grid]:
    """The grids of all worlds, by name, without those that cannot be imported: they are named when they are asked for."""
    found = []
    for name in entries(GRIDS):
        with contextlib.suppress(UserError):
            found.append(grid(name))
    return found


def grids(world: str) -> list[Grid]:
    """The grids of a world, by name."""
    return [found for found in all_grids() if found.world == world]


def offers(kind: Kind, name: str) -> dict[str, str]:
    """What can be said after the name of an adapter, and a word on each; empty for what is a component itself."""
    return {} if ":" in name else dict(declared(kind, name).choices())


def load(kind: Kind, name: str) -> type[Any]:
    """The class of a component; of an adapter's, NAME:CHOICE.

    Raises:
        UserError: if the name or the choice is unknown, or if the plug-in is broken: see `declared`, or it is not a frozen
            dataclass.
    """
    from bench.plugins import contracts

    component = _chosen(kind, name)
    where = _where(GROUPS[kind], name, kind)
    if missing := component.missing():
        raise UserError(f"{where} does not implement {', '.join(missing)}")
    if not (is_dataclass(component) and component.__dataclass_params__.frozen):  # type: ignore[attr-defined]
        raise UserError(f"{where} is not a frozen dataclass: write @dataclass(frozen=True, kw_only=True) above it")
    if positional := [field.name for field in fields(component) if field.init and not field.kw_only]:
        taken = ", ".join(positional)
        raise UserError(f"{where} takes {taken} by position: write @dataclass(frozen=True, kw_only=True)")
    if kind == "attack" and getattr(component, "access", None) not in get_args(contracts.Access):
        levels = ", ".join(get_args(contracts.Access))
        raise UserError(f"{where} must say what it needs: access: ClassVar[Access] = one of {levels}")
    return component


def _chosen(kind: Kind, name: str) -> type[Any]:
    """The component itself, or the one that an adapter has for the choice."""
    component = declared(kind, name)
    own, colon, choice = name.partition(":")
    choices = component.choices()
    if colon and not choices:
        raise UserError(f"{kind} {own!r} leaves no choice; say {own}")
    if not choices:
        return component
    if choice not in choices:
        if not choice:
            raise UserError(f"{kind} {own!r} stands for many; say {own}:NAME, with one of {', '.join(choices)}")
        raise UserError(unknown(f"{kind} {name!r}", choice, choices))
    return component.chosen(choice)


def _plain(name: str) -> str:
    """NAME of NAME:CHOICE."""
    return name.partition(":")[0]


def _where(group: str, name: str, noun: str) -> str:
    """What a message calls the entry of a name."""
    entry = find(group, name, noun)
    return f"{noun} {name!r} ({entry.target} of {entry.shipped_by})"


def unknown(what: str, word: str, known: Iterable[str]) -> str:
    """One line for a word that is not known: what it was, the nearest that is, and all that are."""
    known = list(known)
    near = difflib.get_close_matches(word, known, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return f"unknown {what}; {hint}known: {', '.join(known) or 'there are none'}"
