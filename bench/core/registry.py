"""Finds components by name, through Python entry points only: plug-ins are found exactly as built-in components are.

Listing names imports no component, so `bench list` is quick; a component's module is imported when it is loaded.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib
import inspect
import re
import sys
from collections import UserDict
from collections.abc import Iterable
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, partial
from importlib import metadata
from typing import Any, Literal, get_args

from cavbench.core import checkout
from cavbench.core.names import MARK, plain, split
from cavbench.errors import EscapeError, PluginError, UserError, reason
from cavbench.isolation.foreign import contained, harm, unchanged
from cavbench.scenarios import Grid

Kind = Literal["attack", "defense", "victim", "world"]
KINDS: tuple[Kind, ...] = get_args(Kind)
GROUPS: dict[Kind, str] = {
    "attack": "cavbench.attacks",
    "defense": "cavbench.defenses",
    "victim": "cavbench.victims",
    "world": "cavbench.worlds",
}
OWN = "cavbench"
"""The distribution of the framework and its built-in components."""
REPORTS, TRACKS, GRIDS, SUITES = "cavbench.reports", "cavbench.tracks", "cavbench.grids", "cavbench.suites"


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One name in a group of entry points.

    Args:
        name: name on the command line.
        target: `module:attribute`.
        distribution: name of the pip package that ships it.
        version: version of that package.
    """

    name: str
    target: str
    distribution: str
    version: str

    @property
    def shipped_by(self) -> str:
        """Distribution and version, as in records."""
        return f"{self.distribution} {self.version}"


def entries(group: str) -> dict[str, tuple[Entry, ...]]:
    """All names of an entry-point group, sorted, with their entries: more than one entry is a clash."""
    return installed().get(group, {})


@cache
def installed() -> dict[str, dict[str, tuple[Entry, ...]]]:
    """The entries of all groups of cavbench, by group and name, sorted; every installed distribution is read, once."""
    found: dict[str, dict[str, set[Entry]]] = {}
    # Each question for a name or a version reads the whole metadata of a distribution.
    shipping: dict[int, tuple[str, str]] = {}
    points = metadata.entry_points()
    own = [group for group in points.groups if group.startswith(f"{OWN}.")]
    for point in (point for group in own for point in points.select(group=group)):
        if point.dist and id(point.dist) not in shipping:
            shipping[id(point.dist)] = point.dist.name, point.dist.version
        distribution, version = shipping.get(id(point.dist), ("unknown", "unknown"))
        entry = Entry(name=point.name, target=point.value, distribution=distribution, version=version)
        found.setdefault(point.group, {}).setdefault(point.name, set()).add(entry)
    return {
        group: {name: tuple(sorted(of[name], key=lambda entry: entry.shipped_by)) for name in sorted(of)}
        for group, of in found.items()
    }


def names(kind: Kind) -> list[str]:
    """The names of all components of a kind, without importing any."""
    return list(entries(GROUPS[kind]))


def kinds_of(name: str) -> list[Kind]:
    """The kinds of component that have this name.

    Raises:
        UserError: if there is none.
    """
    kinds = [kind for kind in KINDS if plain(name) in names(kind)]
    if MARK in name and all(link in names("defense") for link in split(name)):
        kinds = ["defense"]
    if not kinds:
        if hint := next(filter(None, (checkout.waiting(group, name) for group in GROUPS.values())), ""):
            raise UserError(f"unknown component {name!r}; {hint}")
        raise UserError(
            unknown(f"component {name!r}", name, sorted({known for kind in KINDS for known in names(kind)}))
        )
    return kinds


def on_track(kind: Kind, name: str, track: str) -> str:
    """The component that a name means on a track: NAME_TRACK if it exists, otherwise NAME."""
    if kind == "defense" and MARK in name:
        return MARK.join(on_track(kind, link, track) for link in split(name))
    specific = f"{name}_{track}"
    return specific if specific in entries(GROUPS[kind]) else name


def problem(claims: tuple[Entry, ...]) -> str:
    """What is wrong with a name, without importing it; empty if nothing is."""
    if len(claims) == 1:
        return ""
    return f"shipped by {' and by '.join(entry.shipped_by for entry in claims)}; uninstall one"


def find(group: str, name: str, noun: str) -> Entry:
    """The entry of NAME or NAME:CHOICE.

    Args:
        group: entry-point group.
        name: NAME or NAME:CHOICE.
        noun: noun for the error message, for instance `attack`.

    Raises:
        UserError: if there is no such entry, or more than one.
    """
    known = entries(group)
    if group == GROUPS["defense"] and MARK in name:
        return _joined([find(group, link, noun) for link in split(name)])
    own = plain(name)
    if own not in known:
        hint = _of_file(name) if noun == "victim" else _of_environment(name) if noun == "world" else ""
        hint = hint or checkout.waiting(group, own)
        raise UserError(f"unknown {noun} {name!r}; {hint}" if hint else unknown(f"{noun} {own!r}", own, known))
    if complaint := problem(known[own]):
        raise UserError(f"{noun} {own!r} is {complaint}")
    return known[own][0]


def is_environment(name: str) -> bool:
    """Whether a name is written like the id of a gymnasium environment: NAME-v0, or MODULE:NAME."""
    return bool(re.fullmatch(r"[\w./-]+:[\w./-]+|[\w./-]+-v\d+", name))


def _of_environment(name: str) -> str:
    """How the environment of an id is given as a world; empty if the name is not that of one."""
    return f"a gymnasium environment is given as world=gym world.id={name}" if is_environment(name) else ""


def _of_file(name: str) -> str:
    """How a file is given as a victim; empty if the name is not that of a file."""
    suffix = name[name.rfind(".") :] if "." in name else ""
    if suffix in (".pt", ".pth"):
        return (
            "such a file has weights without their network: write a .pt2 with torch.export.save and victim=torch "
            "victim.path=… (a detector: victim=detector), or give the network itself to cavbench.score; with Ultralytics' own "
            f"command, `yolo export model={name} format=onnx imgsz=384,1248` writes an .onnx"
        )
    if reader := {".zip": "sb3", ".pt2": "torch", ".onnx": "onnx", ".json": "tfjs"}.get(suffix):
        detector = ", a detector as victim=detector" if suffix in (".pt2", ".onnx") else ""
        return (
            f"a file is given as victim={reader} victim.path={name}{detector} (from Python "
            f'cavbench.component("victim", "{reader}", path={name!r}))'
        )
    return ""


def _joined(links: list[Entry]) -> Entry:
    """The entry of a chain: the targets of its links, and every package that ships one."""
    *others, last = dict.fromkeys((link.distribution, link.version) for link in links)
    distribution = ", ".join([*(" ".join(other) for other in others), last[0]])
    names, targets = MARK.join(link.name for link in links), " + ".join(link.target for link in links)
    return Entry(name=names, target=targets, distribution=distribution, version=last[1])


def resolve(group: str, name: str, noun: str) -> Any:
    """Import the object of an entry point.

    Foreign modules are imported in a copy of this process first, which may end or hang in place of this one. They must leave the
    settings of the process as they are.

    Raises:
        UserError: if there is no such name.
        PluginError: if importing it fails; the message names the package that ships it.
    """
    entry = find(group, name, noun)
    point = metadata.EntryPoint(name=name, value=entry.target, group=group)
    if entry.distribution != OWN and (why := _harm(point.module)):
        raise PluginError(f"{_where(group, name, noun)} cannot be imported: {why}")
    if entry.distribution != OWN:
        _FOREIGN[point.module.partition(".")[0]] = entry.shipped_by
    try:
        with contained(), contextlib.nullcontext() if entry.distribution == OWN else unchanged():
            return point.load()
    # Importing a plug-in may raise anything; that must not break the other components.
    except Exception as error:
        why = reason(error)
        # A second import of it would do nothing, and seem to be harmless.
        if isinstance(error, EscapeError):
            _REFUSED[point.module] = why
        raise PluginError(f"{_where(group, name, noun)} cannot be imported: {why}") from error


def foreign() -> dict[str, str]:
    """The packages of plug-ins that were imported in this process, with their versions, by their top-level modules."""
    return dict(_FOREIGN)


# Plug-ins are imported during a run, too, so these are not among the data that no unit may change (`framework.Snapshot`).
_FOREIGN: UserDict[str, str] = UserDict()
_REFUSED: UserDict[str, str] = UserDict()
"""Foreign modules that are imported and must not be used, with the reason."""


def _harm(module: str) -> str:
    """What importing a module does to a process; empty for nothing, or if it is imported already."""
    return _REFUSED.get(module) or _tried(module)


@cache
def _tried(module: str) -> str:
    why = "" if module in sys.modules else harm(partial(importlib.import_module, module), stays=True)
    return f"its import {why}" if why else ""


def declared(kind: Kind, name: str) -> type[Any]:
    """The class of NAME or NAME:CHOICE: a component, or an adapter with `choices`.

    Raises:
        UserError: if the name is unknown or shipped twice, or the plug-in is broken: it cannot be imported, or is not
            derived from the base class of its kind and of a track.
    """
    from cavbench.core import contracts

    component: Any = resolve(GROUPS[kind], name, kind)
    where = _where(GROUPS[kind], name, kind)
    base = getattr(contracts, kind.capitalize())
    if not (inspect.isclass(component) and issubclass(component, base)):
        raise PluginError(f"{where} is not a subclass of cavbench.core.contracts.{base.__name__}")
    known: type[Any] = component
    if not known.tracks():
        raise PluginError(
            f"{where} belongs to no track: derive it from a base class of cavbench.driving, cavbench.detection or another track"
        )
    return known


def grid(name: str) -> Grid:
    """The grid of this name.

    Raises:
        UserError: if there is no such grid, or its entry point is not a grid.
    """
    found = resolve(GRIDS, name, "grid")
    if not isinstance(found, Grid) or found.name != name:
        raise PluginError(f"{_where(GRIDS, name, 'grid')} is not a cavbench.scenarios.Grid with that name")
    return found


def all_grids() -> list[Grid]:
    """The grids of all worlds, by name, without those that cannot be imported; `grid` reports those."""
    found = []
    for name in entries(GRIDS):
        with contextlib.suppress(UserError):
            found.append(grid(name))
    return found


def grid_of(world: Any) -> Grid:
    """The default grid of a world.

    Args:
        world: a `cavbench.core.contracts.World`.

    Raises:
        UserError: if it is not installed.
    """
    return world.own_grid() or grid(world.grid)


def grids(world: str) -> list[Grid]:
    """The grids of a world, by name."""
    return [found for found in all_grids() if found.world == world]


def offers(kind: Kind, name: str) -> dict[str, str]:
    """The choices of an adapter, each with a short description; empty if the name is a component."""
    return {} if ":" in name or MARK in name else dict(declared(kind, name).choices())


def load(kind: Kind, name: str) -> type[Any]:
    """The class of the component NAME or, for an adapter, NAME:CHOICE.

    Raises:
        UserError: if the name or the choice is unknown, or the plug-in is broken: see `declared`; it also must be a frozen,
            keyword-only dataclass that implements all methods.
    """
    from cavbench.core import contracts

    if kind == "defense" and MARK in name:
        from cavbench.core.chain import chained

        return chained(tuple((link, load(kind, link)) for link in split(name)))
    component = _chosen(kind, name)
    where = _where(GROUPS[kind], name, kind)
    if missing := component.missing():
        raise PluginError(f"{where} does not implement {', '.join(missing)}")
    if not (is_dataclass(component) and component.__dataclass_params__.frozen):  # type: ignore[attr-defined]
        raise PluginError(f"{where} is not a frozen dataclass: write @dataclass(frozen=True, kw_only=True) above it")
    if positional := [field.name for field in fields(component) if field.init and not field.kw_only]:
        taken = ", ".join(positional)
        raise PluginError(f"{where} has the positional parameters {taken}: write @dataclass(frozen=True, kw_only=True)")
    if kind == "attack" and getattr(component, "access", None) not in get_args(contracts.Access):
        levels = ", ".join(get_args(contracts.Access))
        raise PluginError(f"{where} must declare the access it needs: access: ClassVar[Access] = one of {levels}")
    return component


def _chosen(kind: Kind, name: str) -> type[Any]:
    """The component class of NAME, or of an adapter's NAME:CHOICE."""
    component = declared(kind, name)
    adapter, colon, choice = name.partition(":")
    choices = component.choices()
    if colon and not choices:
        raise UserError(f"{kind} {adapter!r} has no choices; write {adapter}")
    if not choices:
        return component
    if choice not in choices:
        if not choice:
            raise UserError(
                f"{kind} {adapter!r} needs a choice; write {adapter}:NAME, with one of {', '.join(choices)}"
            )
        raise UserError(unknown(f"{kind} {name!r}", choice, choices))
    return component.chosen(choice)


def _where(group: str, name: str, noun: str) -> str:
    """The entry of a name, as messages show it."""
    entry = find(group, name, noun)
    return f"{noun} {name!r} ({entry.target} of {entry.shipped_by})"


def unknown(what: str, word: str, known: Iterable[str]) -> str:
    """The message for an unknown word: what it is, the nearest known one, and all known ones."""
    known = list(known)
    near = difflib.get_close_matches(word, known, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return f"unknown {what}; {hint}known: {', '.join(known) or 'none'}"
