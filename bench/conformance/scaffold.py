"""Writes a plug-in package to begin with: an entry point, a small component that works, a test that passes."""

from __future__ import annotations

import keyword
import re
from importlib import resources
from pathlib import Path
from string import Template
from typing import Literal, get_args

from bench.errors import UserError
from bench.plugins import registry
from bench.plugins.contracts import TRACKS

NewKind = Literal["attack", "defense", "victim"]
NOUNS = {"attack": "an attack", "defense": "a defence", "victim": "a victim"}
LINES = {
    ("attack", "driving"): (
        "bench run attack={name} attack.strength=2 lanes=3 density=1 weather=clear episodes=20",
        "attack.strength=2",
    ),
    ("defense", "driving"): (
        "bench run attack=noise,pgd defense={name} lanes=3 density=1 weather=clear episodes=20",
        "defense.copies=16",
    ),
    ("victim", "driving"): (
        "bench run attack=noise,pgd victim={name} lanes=3 density=1 weather=clear episodes=20",
        "victim.gap_m=60",
    ),
    ("attack", "detection"): (
        "bench run attack={name} attack.strength=2 victim=yolov5 lanes=3 density=1 weather=clear",
        "attack.strength=2",
    ),
    ("defense", "detection"): (
        "bench run attack=noise_patch defense={name} victim=yolov5 lanes=3 density=1 weather=clear",
        "defense.size=5",
    ),
    ("victim", "detection"): (
        "bench run attack=noise_patch victim={name} lanes=3 density=1 weather=clear",
        "victim.sharpness=20",
    ),
}
"""A first run of a new component of a kind and track, and one of its parameters."""


def first_run(kind: str, name: str, track: str) -> str:
    """The command that scores a new component on a small part of the grid."""
    return LINES[kind, track][0].format(name=name)


def write(kind: str, name: str, *, track: str = "driving", folder: Path | None = None) -> Path:
    """Write the package of a new component and return its folder.

    Args:
        kind: attack, defense or victim.
        name: what the command line shall call it.
        track: driving or detection.
        folder: must be empty or not there yet; by default `cavbench-NAME` in the current one.

    Raises:
        UserError: if the name cannot be used, the kind or track is unknown, or the folder is not empty.
    """
    if kind not in get_args(NewKind):
        raise UserError(registry.unknown(f"kind {kind!r}", kind, get_args(NewKind)))
    if track not in TRACKS:
        raise UserError(registry.unknown(f"track {track!r}", track, TRACKS))
    _check_name(kind, name)
    distribution = f"cavbench-{name.replace('_', '-')}"
    module = f"cavbench_{name}"
    folder = folder or Path(distribution)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"{folder} is there already and not empty; nothing was written: say out=another-folder")
    article, noun = NOUNS[kind].split()
    run, setting = LINES[kind, track]
    values = {
        "kind": kind,
        "name": name,
        "distribution": distribution,
        "module": module,
        "Class": "".join(part.capitalize() for part in name.split("_")),
        "article": article.capitalize(),
        "noun": noun,
        "run": run.format(name=name),
        "setting": setting,
    }
    files = {
        "pyproject.toml": "pyproject.toml",
        "README.md": "README.md",
        f"{module}.py": f"{kind}_{track}.py",
        f"tests/test_{name}.py": f"test_{kind}_{track}.py",
    }
    templates = resources.files("bench.conformance") / "templates"
    try:
        (folder / "tests").mkdir(parents=True)
        for path, template in files.items():
            text = Template((templates / f"{template}.tmpl").read_text(encoding="utf-8"))
            (folder / path).write_text(text.substitute(values), encoding="utf-8")
    except OSError as error:
        raise UserError(f"{folder} cannot be written: {error.strerror}; say out=another-folder") from error
    return folder


def _check_name(kind: str, name: str) -> None:
    """Raise UserError unless a new component may have the name."""
    if not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name) or keyword.iskeyword(name) or len(name) > 40:
        raise UserError(
            f"{name!r} is no name for {NOUNS[kind]}: write lower-case words joined by _, at most 40 characters, "
            "for instance my_attack"
        )
    claims = registry.entries(f"cavbench.{kind}s").get(name)
    if claims:
        raise UserError(f"{kind} {name!r} is shipped by {claims[0].shipped_by} already; choose another name")
