"""The wheel contains cavbench's packages with their data, and nothing else."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

from bench.shadow import PACKAGES, ROOT

TREE = Path(ROOT)
OWN = ("bench", *PACKAGES)
NOT_SHIPPED = {f"leaderboard/index.{kind}" for kind in ("html", "json", "csv")}
"""The published page, which is generated for readers of the repository."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """The files of a wheel that pip builds from a copy of the tree."""
    folder = tmp_path_factory.mktemp("wheel")
    left = shutil.ignore_patterns(".*", "__pycache__", "build", "dist", "results", "runs", "_build", "*.egg-info")
    copy = shutil.copytree(TREE, folder / "tree", ignore=left)
    pip = (sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", folder, copy)
    subprocess.run(pip, check=True, capture_output=True, text=True)
    (built,) = folder.glob("*.whl")
    return set(zipfile.ZipFile(built).namelist())


@pytest.mark.slow
def test_the_wheel_holds_our_packages_and_nothing_else(wheel: set[str]) -> None:
    assert {name.partition("/")[0] for name in wheel if ".dist-info/" not in name} == {*OWN, "cavbench.py"}


@pytest.mark.slow
def test_the_wheel_holds_every_file_of_our_packages(wheel: set[str]) -> None:
    files = {
        path.relative_to(TREE).as_posix()
        for package in OWN
        for path in (TREE / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert files - NOT_SHIPPED == {name for name in wheel if name.partition("/")[0] in OWN}


def test_the_base_dependencies_are_what_the_packages_import() -> None:
    project = tomllib.loads((TREE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    base = {_name(one) for one in project["dependencies"]}
    extras = project["optional-dependencies"]
    optional = {_name(one) for extra in ("reference", "art", "onnx", "render", "gym") for one in extras[extra]}
    shipped_by = metadata.packages_distributions()
    imported = {_name(one) for module in _imported() for one in shipped_by.get(module, ())}
    # Weights that ship as pip packages are fetched with `python -m pip`.
    assert base - imported == {"pip"}
    assert imported - base <= optional


def _imported() -> set[str]:
    """The top-level packages that cavbench imports, without those of Python and cavbench."""
    found: set[str] = set()
    for path in (path for package in OWN for path in (TREE / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found.add(node.module.partition(".")[0])
    return found - sys.stdlib_module_names - set(OWN)


def _name(requirement: str) -> str:
    """The name of a distribution, as pip compares names."""
    (name,) = re.findall(r"^[\w.-]+", requirement)
    return re.sub(r"[-_.]+", "-", name).lower()
