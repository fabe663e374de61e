"""Reads from the source of a component which tracks it works on, and what it asks for, without importing it."""

from __future__ import annotations

import ast
import contextlib
import importlib.util
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache

from cavbench.core import registry
from cavbench.core.contracts import ANY_TRACK
from cavbench.core.registry import GROUPS, Kind
from cavbench.identity.fingerprint import file_of


def names(kind: Kind, track: str) -> list[str]:
    """The components of a kind that work on a track."""
    return [
        name
        for name, claims in registry.entries(GROUPS[kind]).items()
        if any({track, ANY_TRACK} & set(tracks_of(claim.target)) for claim in claims)
    ]


def tracks_of(target: str) -> list[str]:
    """The tracks of the class `module:Class` of an entry point; empty if the source does not tell.

    They are the values of `track: ... = "..."` in the bodies of the class and its bases, where these can be followed by name.
    """
    return sorted({track for one in _ancestry(target) for track in one.tracks})


def access_of(target: str) -> str:
    """The access that the attack `module:Class` declares, or the nearest of its bases; empty if the source does not tell."""
    return next((one.access for one in _ancestry(target) if one.access), "")


def defaults_of(target: str) -> dict[str, object]:
    """The defaults of the parameters of the class `module:Class`, its own or its bases', as far as the source writes them out."""
    found: dict[str, object] = {}
    for one in reversed(list(_ancestry(target))):
        found |= one.defaults
    return found


def _ancestry(target: str) -> Iterator[_Class]:
    """A class and its bases, the class first, where these can be followed by name."""
    module, _, name = target.partition(":")
    waiting, seen = [(module, name)], set()
    while waiting:
        module, name = place = waiting.pop(0)
        if place in seen:
            continue
        seen.add(place)
        classes, imported = _top_level(module)
        if name not in classes:
            waiting += [imported[name]] if name in imported else []
            continue
        yield classes[name]
        for parent, parent_class in classes[name].bases:
            origin = ".".join(filter(None, imported.get(parent, (parent, "")))) if parent else module
            waiting.append((origin, parent_class))


def summary(target: str) -> str:
    """The first sentence of the docstring of the class `module:Class` of an entry point; empty if the source has none."""
    module, _, name = target.partition(":")
    classes, imported = _top_level(module)
    if name not in classes:
        return summary(":".join(imported[name])) if name in imported and imported[name] != (module, name) else ""
    text = " ".join(classes[name].docstring.partition("\n\n")[0].split())
    # The end of a sentence is no full stop within brackets or of an abbreviation, which a small letter or a number follows.
    for end in re.finditer(r"\.(?=\s+[A-Z`]|$)", text):
        if text.count("(", 0, end.start()) == text.count(")", 0, end.start()):
            return text[: end.start()]
    return text


@dataclass(frozen=True)
class _Class:
    """What is read of a class: its docstring, tracks, the access that it declares ("" for none), the defaults of its fields, and
    its bases as (module or alias, name); "" is the class's own module."""

    docstring: str
    tracks: frozenset[str]
    access: str
    defaults: Mapping[str, object]
    bases: tuple[tuple[str, str], ...]

    @classmethod
    def read(cls, node: ast.ClassDef) -> _Class:
        tracks, access, bases, defaults = set(), "", [], {}
        for line in node.body:
            match line:
                case ast.AnnAssign(target=ast.Name(id="track"), value=ast.Constant(value=str(track))):
                    tracks.add(track)
                case ast.AnnAssign(target=ast.Name(id="access"), value=ast.Constant(value=str(declared))):
                    access = declared
                case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value):
                    # Anything but a constant, a number with a sign, or a tuple of these is computed, and not read here.
                    with contextlib.suppress(ValueError):
                        defaults[name] = ast.literal_eval(value)
        for base in node.bases:
            match base.value if isinstance(base, ast.Subscript) else base:
                case ast.Name(id=name):
                    bases.append(("", name))
                case ast.Attribute(value=ast.Name(id=parent), attr=name):
                    bases.append((parent, name))
        return cls(ast.get_docstring(node) or "", frozenset(tracks), access, defaults, tuple(bases))


@cache
def _top_level(module: str) -> tuple[dict[str, _Class], dict[str, tuple[str, str]]]:
    """The classes of a module, and the origin (module, name) of each name that it imports."""
    path = file_of(module)
    if path is None or path.suffix != ".py":
        return {}, {}
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    classes: dict[str, _Class] = {}
    imported: dict[str, tuple[str, str]] = {}
    try:
        body = list(_statements(ast.parse(path.read_bytes()).body))
    except (SyntaxError, ValueError):
        return {}, {}
    for node in body:
        match node:
            case ast.ClassDef():
                classes[node.name] = _Class.read(node)
            case ast.Import():
                imported |= {alias.asname or alias.name: (alias.name, "") for alias in node.names}
            case ast.ImportFrom():
                base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
                imported |= {alias.asname or alias.name: (base, alias.name) for alias in node.names}
    return classes, imported


def _statements(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """The statements of a module, with those for types: a package may import these names when they are first used."""
    for node in body:
        match node:
            case ast.If(test=ast.Name(id="TYPE_CHECKING")):
                yield from node.body
            case _:
                yield node
