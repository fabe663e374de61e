"""Creates a plug-in package: an entry point, a small component that works, and tests that pass."""

from __future__ import annotations

import keyword
import re
from collections.abc import Mapping
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from string import Template
from typing import Literal, cast, get_args

from cavbench.checks import kits
from cavbench.checks.kits import Kit
from cavbench.core import registry, sources
from cavbench.core.options import DEFAULTS
from cavbench.core.registry import Kind
from cavbench.errors import UserError

NewKind = Literal["attack", "defense", "victim", "world"]
NOUNS = {"attack": "an attack", "defense": "a defence", "victim": "a victim", "world": "a world"}
GRID = "_grid"
"""The end of the name of a world's second module, which has its axes and its grid."""


def default_track() -> str:
    """The track of the default victim of a run."""
    entry = registry.find(registry.GROUPS["victim"], DEFAULTS["victim"], "victim")
    return sources.tracks_of(entry.target)[0]


def first_run(kind: str, name: str, track: str) -> str:
    """The command that scores a new component on a small part of the grid.

    Raises:
        UserError: if the kind or the track is unknown, or the track has no template for the kind.
    """
    return kit_of(kind, track).starts[cast(Kind, kind)].run.format(name=name)


def write(kind: str, name: str, *, track: str, folder: Path | None = None) -> Path:
    """Write the package of a new component and return its folder.

    Args:
        kind: attack, defense, victim or world.
        name: name on the command line.
        track: a track with templates.
        folder: a folder that is empty or does not exist; by default `cavbench-NAME` in the current folder.

    Raises:
        UserError: if the name is not allowed, there is no template, or the folder is not empty or cannot be written.
    """
    kit = kit_of(kind, track)
    check_name(kind, name)
    distribution = f"cavbench-{name.replace('_', '-')}"
    module = f"cavbench_{name}"
    folder = folder or Path(distribution)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"{folder} exists and is not empty; nothing was written: choose another folder with out=")
    article, noun = NOUNS[kind].split()
    grid = f"{name.replace('_', '-')}-v1"
    modules = [module, f"{module}{GRID}"] if kind == "world" else [module]
    values = {
        "kind": kind,
        "name": name,
        "distribution": distribution,
        "module": module,
        "Class": class_name(name),
        "article": article.capitalize(),
        "noun": noun,
        "run": first_run(kind, name, track),
        "setting": kit.starts[cast(Kind, kind)].setting,
        "grid": grid,
        "modules": ", ".join(f'"{each}"' for each in modules),
        "more": f'\n[project.entry-points."cavbench.grids"]\n{grid} = "{modules[-1]}:GRID"\n'
        if kind == "world"
        else "",
    }
    common, special = (resources.files(package) / "templates" for package in ("cavbench.checks", kit.package))
    files = {
        "pyproject.toml": common / "pyproject.toml.tmpl",
        "README.md": common / "README.md.tmpl",
        f"{module}.py": special / f"{kind}.py.tmpl",
        f"tests/test_{name}.py": special / f"test_{kind}.py.tmpl",
    }
    if kind == "world":
        files[f"{module}{GRID}.py"] = special / f"{kind}{GRID}.py.tmpl"
    try:
        (folder / "tests").mkdir(parents=True)
        for path, template in files.items():
            (folder / path).write_text(filled(template, values), encoding="utf-8")
    except OSError as error:
        raise UserError(f"{folder} cannot be written: {error.strerror}; choose another folder with out=") from error
    return folder


def filled(template: Traversable, values: Mapping[str, str]) -> str:
    """The text of a template with its `$names` replaced."""
    return Template(template.read_text(encoding="utf-8")).substitute(values)


def class_name(name: str) -> str:
    """The class of a component: MyAttack for my_attack."""
    return "".join(part.capitalize() for part in name.split("_"))


def kit_of(kind: str, track: str) -> Kit:
    """The kit of a track with a template for the kind; UserError if there is none."""
    if kind not in get_args(NewKind):
        raise UserError(registry.unknown(f"kind {kind!r}", kind, get_args(NewKind)))
    known = registry.entries(registry.TRACKS)
    if track not in known:
        raise UserError(registry.unknown(f"track {track!r}", track, known))
    kit = kits.kit(track)
    if kit is None or kind not in kit.starts:
        others = [name for name in kits.kits() if (other := kits.kit(name)) is not None and kind in other.starts]
        raise UserError(
            f"the track {track!r} has no template for {NOUNS[kind]}; tracks with templates: {', '.join(others)}"
        )
    return kit


def check_name(kind: str, name: str) -> None:
    """Raise UserError unless the name is valid and not taken."""
    if not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name) or keyword.iskeyword(name) or len(name) > 40:
        raise UserError(
            f"{name!r} is not a valid name for {NOUNS[kind]}: write lower-case words joined by _, at most 40 characters, "
            "for instance my_attack"
        )
    claims = registry.entries(f"cavbench.{kind}s").get(name)
    if claims:
        raise UserError(f"{kind} {name!r} is already shipped by {claims[0].shipped_by}; choose another name")
