"""Reads from the source of a component which tracks it works on, without importing it."""

from __future__ import annotations

import ast
import importlib.util
import re
from functools import cache

from bench.plugins import registry
from bench.plugins.contracts import ANY_TRACK
from bench.plugins.fingerprint import file_of
from bench.plugins.registry import GROUPS, Kind


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
    module, _, name = target.partition(":")
    waiting, seen, found = [(module, name)], set(), set()
    while waiting:
        module, name = place = waiting.pop()
        if place in seen:
            continue
        seen.add(place)
        classes, imported = _top_level(module)
        if name not in classes:
            waiting += [imported[name]] if name in imported else []
            continue
        for node in classes[name].body:
            match node:
                case ast.AnnAssign(target=ast.Name(id="track"), value=ast.Constant(value=str(track))):
                    found.add(track)
        for base in classes[name].bases:
            match base.value if isinstance(base, ast.Subscript) else base:
                case ast.Name(id=parent_class):
                    waiting.append((module, parent_class))
                case ast.Attribute(value=ast.Name(id=parent), attr=parent_class):
                    waiting.append((".".join(filter(None, imported.get(parent, (parent, "")))), parent_class))
    return sorted(found)


def summary(target: str) -> str:
    """The first sentence of the docstring of the class `module:Class` of an entry point; empty if the source has none."""
    module, _, name = target.partition(":")
    classes, imported = _top_level(module)
    if name not in classes:
        return summary(":".join(imported[name])) if name in imported and imported[name] != (module, name) else ""
    text = " ".join((ast.get_docstring(classes[name]) or "").partition("\n\n")[0].split())
    # The end of a sentence is no full stop within brackets or of an abbreviation, which a small letter or a number follows.
    for end in re.finditer(r"\.(?=\s+[A-Z`]|$)", text):
        if text.count("(", 0, end.start()) == text.count(")", 0, end.start()):
            return text[: end.start()]
    return text


@cache
def _top_level(module: str) -> tuple[dict[str, ast.ClassDef], dict[str, tuple[str, str]]]:
    """The classes of a module, and the origin (module, name) of each name that it imports."""
    path = file_of(module)
    if path is None or path.suffix != ".py":
        return {}, {}
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    classes: dict[str, ast.ClassDef] = {}
    imported: dict[str, tuple[str, str]] = {}
    try:
        body = ast.parse(path.read_bytes()).body
    except (SyntaxError, ValueError):
        return {}, {}
    for node in body:
        match node:
            case ast.ClassDef():
                classes[node.name] = node
            case ast.Import():
                imported |= {alias.asname or alias.name: (alias.name, "") for alias in node.names}
            case ast.ImportFrom():
                base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
                imported |= {alias.asname or alias.name: (base, alias.name) for alias in node.names}
    return classes, imported
