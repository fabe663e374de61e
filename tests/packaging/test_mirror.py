"""Tests mirror the package: every component is tested where one looks for it, and a test lies beside no other module's tests."""

from __future__ import annotations

from pathlib import PurePosixPath

import pytest

from cavbench.core.registry import KINDS
from tests.attacks.test_every_attack import ATTACKS
from tests.checks.rules import built_in
from tests.defenses.test_every_defense import DEFENSES
from tests.detection.victims.test_every_detector import DETECTORS
from tests.driving.victims.test_every_driver import DRIVERS
from tests.envs.test_every_world import WORLDS
from tests.tree import FOLDERS, ROOT

TABLES = {"attack": ATTACKS, "defense": DEFENSES, "victim": DETECTORS | DRIVERS, "world": WORLDS}
"""The components of each kind that one table-driven test checks."""
TESTS = ROOT / "tests"
NO_MIRROR = {"docs", "packaging", "plugins", "soak"}
"""Folders of tests of what is no module: pages, the wheel, plug-ins of users, and long runs."""
COMPONENTS = [(kind, name, module) for kind in KINDS for name, module in built_in(kind).items()]


def modules() -> set[str]:
    """The paths of all modules and packages in `cavbench`, without an ending."""
    found = set()
    for folder, place in FOLDERS.items():
        for path in (ROOT / folder).rglob("*.py"):
            inner = (PurePosixPath(place) / path.relative_to(ROOT / folder)).relative_to("cavbench").with_suffix("")
            found.add(inner.as_posix().removesuffix("/__init__"))
    return found


MODULES = modules()
FILES = [path.relative_to(TESTS) for path in sorted(TESTS.rglob("test_*.py"))]
MIRRORED = [path for path in FILES if path.parts[0] not in NO_MIRROR]


@pytest.mark.parametrize(("kind", "name", "module"), COMPONENTS, ids=[f"{one[0]}-{one[1]}" for one in COMPONENTS])
def test_every_component_has_a_test_of_its_name_or_is_in_a_table(kind: str, name: str, module: str) -> None:
    *folders, own = module.split(".")[1:]
    file = TESTS.joinpath(*folders, f"test_{own}.py")
    assert name in TABLES[kind] or file.exists(), f"add it to a table, or write {file.relative_to(ROOT)}"


def test_every_folder_of_tests_is_one_of_the_package() -> None:
    folders = {path.parent.as_posix() for path in MIRRORED} - {"."}
    assert folders - MODULES == set()


def test_a_test_with_the_name_of_a_module_lies_in_its_folder() -> None:
    misplaced = {}
    for path in MIRRORED:
        own, here = path.stem.removeprefix("test_"), path.parent.as_posix()
        homes = {module for module in MODULES if module.rpartition("/")[2] == own}
        if homes and not {f"{here}/{own}".removeprefix("./"), here} & homes:
            misplaced[str(path)] = homes
    assert misplaced == {}
