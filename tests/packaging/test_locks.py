"""What is installed has a hash in a lock, pip takes no other file, and each has a licence that somebody has looked at."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from locks.install_torch import pinned
from locks.licences import complaints, licence, plain
from tests.tree import ROOT as TREE

ELSEWHERE = {"torch", "cavbench"}
"""torch has locks of its own."""


def lock(name: str) -> dict[str, str]:
    """The versions in a lock, by name; each must be exact, with a hash, and name no index."""
    text = (TREE / "locks" / f"{name}.txt").read_text()
    assert "://" not in text
    found = {}
    for part in re.split(r"^(?=[^\s#])", text, flags=re.MULTILINE)[1:]:
        first, *hashes = part.replace("\\\n", "\n").strip().splitlines()
        exact = re.fullmatch(r"([\w.-]+)==([\w.!+-]+)( ; .+)?", first.strip())
        assert exact, first
        assert hashes
        assert all(re.fullmatch(r"--hash=sha256:[0-9a-f]{64}", line.strip()) for line in hashes)
        # One distribution may have several versions, for several Pythons.
        found[plain(exact[1])] = f"{found.get(plain(exact[1]), '')} {exact[2]}".strip()
    return found


UNLOCKED = {"log", "sumo"}
"""Extras that neither `make run` nor `make test` installs (docs/trust.md)."""
PROJECT = tomllib.loads((TREE / "pyproject.toml").read_text())["project"]


def required(extra: str = "") -> dict[str, SpecifierSet]:
    """What an extra, or the package without one, asks for, by name."""
    listed = PROJECT["optional-dependencies"][extra] if extra else PROJECT["dependencies"]
    return {plain(one.name): one.specifier for one in map(Requirement, listed) if one.name not in ELSEWHERE}


def unmet(wanted: dict[str, SpecifierSet], locked: dict[str, str]) -> list[str]:
    """What a lock has not, or in a version that is not allowed."""
    return [
        f"{name}{allowed}"
        for name, allowed in wanted.items()
        if not all(map(allowed.contains, locked.get(name, "0").split()))
    ]


def test_the_locks_hold_all_that_is_required_in_the_versions_of_the_constraints() -> None:
    run, develop, build = lock("run"), lock("develop"), lock("build")
    assert unmet(required(), run) == []
    extras = PROJECT["optional-dependencies"].keys() - UNLOCKED
    assert [one for extra in extras for one in unmet(required(extra), develop)] == []
    # Otherwise it belongs in the set above no longer.
    assert all(unmet(required(extra), develop) for extra in UNLOCKED)
    assert run.items() <= develop.items()
    assert build.items() <= run.items()
    assert not {name for name in develop if re.match(r"torch$|nvidia-|cuda-|triton", name)}
    pins = re.findall(r"^([\w.-]+)==(\S+)$", (TREE / "constraints.txt").read_text(), re.M)
    for name, version in pins:
        if plain(name) not in ELSEWHERE:
            assert version in develop[plain(name)].split(), name


def test_both_builds_of_torch_are_locked_in_the_version_of_the_constraints() -> None:
    version = pinned()
    index, cpu = lock("torch"), lock("torch-cpu")
    assert cpu == {"torch": f"{version}+cpu"}
    assert index["torch"] == version
    assert all(re.match(r"torch$|nvidia-|cuda-|triton", name) for name in index)
    # Linux on two kinds of processor, and three Pythons, besides macOS and Windows.
    hashes = re.search(r"^torch==.*?(?=^\S)", (TREE / "locks" / "torch.txt").read_text() + "end", re.M | re.S)
    assert hashes
    assert hashes[0].count("sha256:") >= 6


def offered(folder: Path, name: str, version: str) -> None:
    """An empty wheel with the name of another, in a folder."""
    folder.mkdir(exist_ok=True)
    begin = f"{name.replace('-', '_')}-{version}"
    with zipfile.ZipFile(folder / f"{begin}-py3-none-any.whl", "w") as wheel:
        wheel.writestr(f"{begin}.dist-info/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        wheel.writestr(f"{begin}.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(f"{begin}.dist-info/RECORD", "")


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment with nothing but pip."""
    place = tmp_path_factory.mktemp("bare")
    venv.create(place, with_pip=True, symlinks=True)
    return place / ("Scripts" if sys.platform == "win32" else "bin") / "python"


@pytest.mark.parametrize("name", ["torch", "torch-cpu"])
def test_a_file_that_calls_itself_torch_is_refused(name: str, bare: Path, tmp_path: Path) -> None:
    for distribution, version in lock(name).items():
        offered(tmp_path / "wheels", distribution, version)
    told = installed(bare, tmp_path)
    assert told.returncode == 1
    assert "DO NOT MATCH THE HASHES" in told.stderr
    assert f"torch {lock(name)['torch']} was not installed" in told.stderr
    assert not list(bare.parent.parent.rglob("torch-*"))


def test_a_build_of_torch_without_a_lock_is_one_line(bare: Path, tmp_path: Path) -> None:
    offered(tmp_path / "wheels", "torch", f"{pinned()}+other")
    told = installed(bare, tmp_path)
    assert told.returncode == 1
    assert told.stderr.startswith(f"no lock has torch {pinned()}+other, the build that pip takes here. ")


def test_a_torch_that_is_there_stays(tmp_path: Path) -> None:
    told = installed(Path(sys.executable), tmp_path)
    assert (told.returncode, told.stdout, told.stderr) == (0, "", "")


def installed(python: Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """Install torch where only the folder `wheels` offers it."""
    pip = {"PIP_CONFIG_FILE": os.devnull, "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(folder / "wheels")}
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")} | pip
    command = (str(python), str(TREE / "locks" / "install_torch.py"))
    return subprocess.run(command, env=environment, check=False, capture_output=True, text=True)


def test_all_that_is_installed_states_a_licence_that_may_be_used() -> None:
    # Other tests put made-up packages on the path.
    installed = metadata.distributions(path=[sysconfig.get_path("purelib")])
    assert complaints((one.name, licence(one.name, one.metadata)) for one in installed) == []


@pytest.mark.parametrize(
    ("text", "bad"),
    [
        ("MIT", False),
        ("BSD License, Apache Software License", False),
        ("AGPL-3.0-only", True),
        ("GNU General Public License v3 (GPLv3)", True),
        ("GNU Library or Lesser General Public License (LGPL)", True),
        ("CC BY-NC 4.0", True),
        ("", True),
    ],
)
def test_a_licence_that_asks_for_more_is_named(text: str, bad: bool) -> None:
    found = complaints([("some-thing", text)])
    assert bool(found) == bad
    assert all(line.startswith("some-thing ") for line in found)
    assert complaints([("pygame_ce", "LGPL-2.1")]) == []
