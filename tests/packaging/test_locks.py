"""Every distribution that is installed has a hash in a lock, and a licence that somebody has looked at."""

from __future__ import annotations

import re
import sysconfig
import tomllib
from importlib import metadata

import pytest

from locks.licences import complaints, licence, plain
from tests.tree import ROOT as TREE

NOT_LOCKED = {"torch", "cavbench"}
"""The builds of torch differ from index to index."""


def lock(name: str) -> dict[str, str]:
    """The versions in a lock, by name; each must be exact, with a hash, and name no index."""
    text = (TREE / "locks" / f"{name}.txt").read_text()
    assert "://" not in text
    found = {}
    for part in re.split(r"^(?=[^\s#])", text, flags=re.MULTILINE)[1:]:
        first, *hashes = part.replace("\\\n", "\n").strip().splitlines()
        pinned = re.fullmatch(r"([\w.-]+)==([\w.!+-]+)( ; .+)?", first.strip())
        assert pinned, first
        assert hashes
        assert all(re.fullmatch(r"--hash=sha256:[0-9a-f]{64}", line.strip()) for line in hashes)
        # One distribution may have several versions, for several Pythons.
        found[plain(pinned[1])] = f"{found.get(plain(pinned[1]), '')} {pinned[2]}".strip()
    return found


def required(extra: str = "") -> set[str]:
    project = tomllib.loads((TREE / "pyproject.toml").read_text())["project"]
    listed = project["optional-dependencies"][extra] if extra else project["dependencies"]
    return {plain(re.match(r"[\w.-]+", one)[0]) for one in listed}  # type: ignore[index]


def test_the_locks_hold_all_that_is_required_in_the_versions_of_the_constraints() -> None:
    run, develop, build = lock("run"), lock("develop"), lock("build")
    assert required() - NOT_LOCKED <= run.keys()
    extras = ("reference", "gym", "art", "onnx", "ray", "render", "docs", "dev")
    assert set().union(*map(required, extras)) - NOT_LOCKED <= develop.keys()
    assert run.items() <= develop.items()
    assert build.items() <= run.items()
    assert not {name for name in develop if re.match(r"torch$|nvidia-|cuda-|triton", name)}
    pins = re.findall(r"^([\w.-]+)==(\S+)$", (TREE / "constraints.txt").read_text(), re.M)
    for name, version in pins:
        if plain(name) not in NOT_LOCKED:
            assert version in develop[plain(name)].split(), name


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
