"""The built-in components, as pyproject.toml names them, and the rules that one of them breaks."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from typing import Any

import pytest

from cavbench.checks import examine
from cavbench.core.registry import GROUPS, Kind
from tests.tree import ROOT

SLOW = {"eot", "plan", "planner", "rehearse", "shield", "transfer"}
"""Components whose checks take more than a few seconds."""


def built_in(kind: Kind, package: str = "cavbench") -> dict[str, str]:
    """The modules of the built-in components of a kind that are in a package, by name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    points = {name: target.partition(":")[0] for name, target in project["entry-points"][GROUPS[kind]].items()}
    return {name: module for name, module in points.items() if module.startswith(f"{package}.")}


def each(names: Iterable[str]) -> pytest.MarkDecorator:
    """Run a test once with each name, marked as slow where it is."""
    marked = [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in names]
    return pytest.mark.parametrize("name", marked)


def broken(kind: Kind, name: str, **values: Any) -> dict[str, str]:
    """What is to be fixed in a component, by check. What it does must have been checked, too."""
    return {
        outcome.check: outcome.text
        for outcome in examine(kind, name, values)
        if outcome.status == "fail" or (outcome.status == "skip" and outcome.check.endswith("behaviour"))
    }
