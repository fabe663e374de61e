"""Adds a built-in component to a checkout of cavbench: code, entry point, page and test."""

from __future__ import annotations

import tomllib
from importlib import resources
from pathlib import Path
from typing import cast

from cavbench.checks import scaffold
from cavbench.checks.kits import Home
from cavbench.core import checkout
from cavbench.core.registry import GROUPS, Kind
from cavbench.errors import UserError
from cavbench.files import whole

FIRST_PARTY = frozenset([__name__.partition(".")[0]])
"""The packages of cavbench that templates import from."""


def write(kind: str, name: str, *, track: str, folder: Path | None = None) -> list[Path]:
    """Write a built-in component and return its files: code, pyproject.toml, page and test.

    Args:
        kind: attack, defense or victim.
        name: name on the command line.
        track: a track of cavbench itself.
        folder: the checkout; by default the one that this process runs from.

    Raises:
        UserError: if the name is not allowed, the folder is no checkout, there is no template, or a file exists or cannot be
            written. Then nothing is written.
    """
    kit = scaffold.kit_of(kind, track)
    scaffold.check_name(kind, name)
    home = kit.homes.get(cast(Kind, kind))
    if home is None:
        raise UserError(
            f"the track {track!r} has no place for a built-in {kind}; leave --builtin out to write a plug-in"
        )
    folder = folder or checkout.root()
    if folder is None or not checkout.is_checkout(folder):
        where = f"{folder} is none" if folder else "this one is installed from a wheel"
        raise UserError(f"--builtin writes to a checkout of cavbench, and {where}: name it with out=")
    texts = _files(kind, name, home, kit.package, scaffold.first_run(kind, name, track))
    paths = {folder / path: text for path, text in texts.items()}
    if there := [path for path in paths if path.exists()]:
        raise UserError(f"{there[0]} exists; nothing was written: choose another name")
    project = folder / "pyproject.toml"
    target = f"{home.package}.{name}:{scaffold.class_name(name)}"
    try:
        entered = with_entry(project.read_text(encoding="utf-8"), GROUPS[cast(Kind, kind)], name, target)
        for path, text in {**paths, project: entered}.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            with whole(path) as made:
                made.write(text.encode())
    except OSError as error:
        raise UserError(f"{folder} cannot be written: {error.strerror}") from error
    code, page, test = paths
    return [code, project, page, test]


def _files(kind: str, name: str, home: Home, package: str, run: str) -> dict[str, str]:
    """The texts of code, page and test, by their paths in the checkout."""
    module = f"{home.package}.{name}"
    values = {"kind": kind, "name": name, "module": module, "Class": scaffold.class_name(name), "run": run}
    templates = resources.files(package) / "templates"
    ours = FIRST_PARTY | {module.partition(".")[0]}
    return {
        f"{home.folder}/{name}.py": grouped(scaffold.filled(templates / f"{kind}.py.tmpl", values), ours),
        f"docs/{kind}s/{name}.md": scaffold.filled(templates / f"{kind}.md.tmpl", values),
        f"{home.tests}/test_{name}.py": grouped(scaffold.filled(templates / f"test_{kind}.py.tmpl", values), ours),
    }


def grouped(text: str, ours: frozenset[str]) -> str:
    """A module whose imports from our own packages stand in a group of their own, after all others, as ruff wants it here.

    In a plug-in cavbench is a library like any other.

    Args:
        text: a module with one import a line.
        ours: our top-level packages.
    """
    lines = text.splitlines()
    places = [number for number, line in enumerate(lines) if line.startswith(("import ", "from "))]
    own = [lines[number] for number in places if lines[number].split()[1].partition(".")[0] in ours]
    kept = [line for number, line in enumerate(lines) if number not in places or line not in own]
    last = max(number for number, line in enumerate(kept) if line.startswith(("import ", "from ")))
    before, after = kept[: last + 1], "\n".join(kept[last + 1 :]).lstrip("\n")
    return "\n".join([*before, "", *sorted(own, key=lambda line: line.split()[1]), *_gap(after), after, ""])


def _gap(after: str) -> list[str]:
    """Two empty lines before a definition, one before anything else."""
    return ["", ""] if after.startswith(("@", "class ", "def ")) else [""]


def with_entry(project: str, group: str, name: str, target: str) -> str:
    """The text of a pyproject.toml with one more entry point, at the end of its group.

    Raises:
        UserError: if the text has no such group, or has the name in it already.
    """
    header = f'[project.entry-points."{group}"]'
    before, found, rest = project.partition(f"{header}\n")
    known = tomllib.loads(project)["project"].get("entry-points", {}).get(group, {})
    if not found or name in known:
        raise UserError(
            f"pyproject.toml has {f'{name!r} already' if found else 'no table ' + header}; nothing was written"
        )
    lines = rest.split("\n")
    end = next((number for number, line in enumerate(lines) if not line or line.startswith("[")), len(lines))
    return before + found + "\n".join([*lines[:end], f'{name} = "{target}"', *lines[end:]])
