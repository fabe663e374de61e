"""The wheel contains cavbench's packages with their data, and nothing else."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

from tests.tree import FOLDERS
from tests.tree import ROOT as TREE

FIRST_RUN = ("attack=noise", "lanes=3", "density=1", "weather=clear", "episodes=5")
NOT_SHIPPED = {f"cavbench/leaderboard/index.{kind}" for kind in ("html", "json", "csv", "tex")}
"""The page of the published records, which `make page` builds."""


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the tree."""
    left = shutil.ignore_patterns(".*", "__pycache__", "build", "dist", "results", "runs", "_build", "*.egg-info")
    return shutil.copytree(TREE, tmp_path_factory.mktemp("copy") / "tree", ignore=left)


@pytest.fixture(scope="module")
def built(copy: Path) -> Path:
    """A wheel that pip builds from it."""
    folder = copy.parent
    pip = (sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", folder, copy)
    subprocess.run(pip, check=True, capture_output=True, text=True)
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def wheel(built: Path) -> set[str]:
    """The files of the wheel."""
    return set(zipfile.ZipFile(built).namelist())


@pytest.mark.slow
def test_the_wheel_holds_our_packages_and_nothing_else(wheel: set[str]) -> None:
    assert {name.partition("/")[0] for name in wheel if ".dist-info/" not in name} == {"cavbench"}


@pytest.mark.slow
def test_the_wheel_holds_every_file_of_our_packages(wheel: set[str]) -> None:
    files = {
        f"{place}/{path.relative_to(TREE / folder).as_posix()}"
        for folder, place in FOLDERS.items()
        for path in (TREE / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert files - NOT_SHIPPED == {name for name in wheel if ".dist-info/" not in name}


@pytest.mark.skipif("CAVBENCH_WHEEL_CHECK" not in os.environ, reason="make wheel-check installs 2 GB")
def test_the_wheel_runs_in_an_environment_of_its_own(built: Path, tmp_path: Path) -> None:
    python = tmp_path / "venv" / "bin" / "python"
    limits = ("-c", TREE / "constraints.txt")
    for command in (
        (sys.executable, "-m", "venv", tmp_path / "venv"),
        (python, "-m", "pip", "install", "--quiet", *limits, "torch==2.13.0"),
        (python, "-m", "pip", "install", "--quiet", *limits, built),
        (python.with_name("bench"), "--version"),
        (python.with_name("bench"), "run", *FIRST_RUN, "out=results"),
        (python, "-c", "import cavbench; print(cavbench.load('dqn+advtrain'))"),
    ):
        said = subprocess.run(command, cwd=tmp_path, env=_outside(), capture_output=True, text=True, check=False)
        assert said.returncode == 0, said.stderr
    assert len(list((tmp_path / "results" / "episodes").glob("*.parquet"))) == 14


def _outside() -> dict[str, str]:
    """The environment variables without those that lead to this tree."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}


@pytest.mark.slow
def test_the_source_distribution_builds_the_same_wheel(wheel: set[str], copy: Path, tmp_path: Path) -> None:
    build = "import sys; from setuptools.build_meta import build_sdist; build_sdist(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, tmp_path], cwd=copy, check=True, capture_output=True)
    (archive,) = tmp_path.glob("*.tar.gz")
    pip = (
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "-w",
        tmp_path,
        archive,
    )
    subprocess.run(pip, check=True, capture_output=True, text=True)
    (again,) = tmp_path.glob("*.whl")
    assert set(zipfile.ZipFile(again).namelist()) == wheel


def test_the_version_is_the_same_everywhere() -> None:
    version = tomllib.loads((TREE / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    written = {
        "CITATION.cff": rf"^version: {re.escape(version)}$",
        "README.md": rf"version = {{{re.escape(version)}}}",
        "docs/submit.md": rf"version = {{{re.escape(version)}}}",
        "docs/install.md": rf"cavbench-{re.escape(version)}-py3-none-any\.whl",
    }
    assert [name for name, text in written.items() if not re.search(text, (TREE / name).read_text(), re.M)] == []


def test_the_base_dependencies_are_what_the_packages_import() -> None:
    project = tomllib.loads((TREE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    base = {_name(one) for one in project["dependencies"]}
    extras = project["optional-dependencies"]
    optional = {
        _name(one) for extra in ("reference", "art", "onnx", "render", "gym", "ray", "plot") for one in extras[extra]
    }
    shipped_by = metadata.packages_distributions()
    imported = {_name(one) for module in _imported() for one in shipped_by.get(module, ())}
    # Weights that ship as pip packages are fetched with `python -m pip`.
    assert base - imported == {"pip"}
    # A callback of Stable-Baselines3 is for those who have it.
    assert imported - base - optional == {"stable-baselines3"}


def _imported() -> set[str]:
    """The top-level packages that cavbench imports, without those of Python and cavbench."""
    found: set[str] = set()
    for path in (path for folder in FOLDERS for path in (TREE / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found.add(node.module.partition(".")[0])
    return found - sys.stdlib_module_names - {"cavbench"}


def _name(requirement: str) -> str:
    """The name of a distribution, as pip compares names."""
    (name,) = re.findall(r"^[\w.-]+", requirement)
    return re.sub(r"[-_.]+", "-", name).lower()
