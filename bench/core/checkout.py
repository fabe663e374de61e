"""The checkout of cavbench that this process runs from, if it does: what its pyproject.toml says."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from typing import Any

NAME = "cavbench"


@cache
def root() -> Path | None:
    """The folder of the checkout; None if cavbench was installed from a wheel."""
    return next((folder for folder in Path(__file__).parents if is_checkout(folder)), None)


def is_checkout(folder: Path) -> bool:
    """Whether a folder is a checkout of cavbench."""
    return (folder / "pyproject.toml").is_file() and _project(folder).get("name") == NAME


def entry_points(folder: Path) -> dict[str, dict[str, str]]:
    """The entry points in the pyproject.toml of a folder, by group and name; installed or not."""
    found: dict[str, dict[str, str]] = _project(folder).get("entry-points", {})
    return found


def waiting(group: str, name: str) -> str:
    """What to type for an entry point that was written to the checkout but not installed yet; empty if there is none."""
    folder = root()
    if folder is None or name not in entry_points(folder).get(group, {}):
        return ""
    return f"{folder / 'pyproject.toml'} names it, but it is not installed yet: pip install --no-deps -e {folder}"


def _project(folder: Path) -> dict[str, Any]:
    try:
        found: dict[str, Any] = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return dict(found.get("project", {}))
