"""`bench new --builtin`: four files in a checkout, which follow its rules once they are installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from cavbench.checks.builtin import with_entry
from cavbench.core.checkout import entry_points
from cavbench.errors import UserError
from tests.checks.test_scaffold import EVERY, TESTS, name_of
from tests.cli.test_cli import assert_one_line
from tests.command import SETTINGS, Said, import_path
from tests.plugins.distributions import install
from tests.tree import FOLDERS, ROOT

CODE = (*FOLDERS, "tests")
BUILT_IN = [one for one in EVERY if one[0] != "world"]
"""What `bench new --builtin` writes: a world is a plug-in only, and has two tests."""
Bench = Callable[..., Said]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout of cavbench: its own pyproject.toml, and links to all other files."""
    folder = tmp_path / "checkout"
    folder.mkdir()
    for name in (*CODE, "docs"):
        # With what is compiled already: kernels would take half a minute again.
        unwanted = shutil.ignore_patterns("_build")
        shutil.copytree(ROOT / name, folder / name, copy_function=os.symlink, ignore=unwanted)
    for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        (folder / name).symlink_to(ROOT / name)
    shutil.copy(ROOT / "pyproject.toml", folder)
    for inner, place in FOLDERS.items():
        # As `make tree`: what a finder does for an editable installation.
        for path in (folder / inner).iterdir() if inner == "bench" else [folder / inner]:
            link = folder / "build" / "tree" / place / (path.name if inner == "bench" else "")
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(path)
    return folder


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def typed(checkout: Path, site: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python in the checkout, with the distributions in `site`."""
    environment = os.environ | SETTINGS | {"PYTHONPATH": import_path(site, checkout / "build" / "tree")}
    command = [sys.executable, *words]
    return subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True, check=False)


def test_a_built_in_component_is_four_files(bench: Bench, checkout: Path) -> None:
    before, project = files(checkout), (checkout / "pyproject.toml").read_text()
    said = bench("new", "attack", "my_attack", "--builtin", f"out={checkout}")
    assert said.code == 0, said.err
    assert files(checkout) - before == {
        "attacks/driving/my_attack.py",
        "docs/attacks/my_attack.md",
        "tests/attacks/driving/test_my_attack.py",
    }
    now = (checkout / "pyproject.toml").read_text()
    assert [line for line in now.splitlines() if line not in project.splitlines()] == [
        'my_attack = "cavbench.attacks.driving.my_attack:MyAttack"'
    ]
    assert now.replace('my_attack = "cavbench.attacks.driving.my_attack:MyAttack"\n', "") == project
    for part in (f"pip install --no-deps -e {checkout}", "bench check my_attack", "make docs"):
        assert part in said.out


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("attack", "zo"), "attack 'zo' is already shipped by cavbench"),
        (("attack", "suites"), "suites.py exists; nothing was written: choose another name"),
        (("attack", "MyAttack"), "'MyAttack' is not a valid name"),
        (("world", "my_world"), "the track 'driving' has no place for a built-in world"),
    ],
)
def test_a_name_that_is_taken_or_bad_is_refused_and_nothing_is_written(
    bench: Bench, checkout: Path, words: tuple[str, ...], part: str
) -> None:
    before, project = files(checkout), (checkout / "pyproject.toml").read_text()
    assert_one_line(bench("new", *words, "--builtin", f"out={checkout}"), part)
    assert files(checkout) == before
    assert (checkout / "pyproject.toml").read_text() == project


def test_another_folder_than_a_checkout_is_refused(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").write_text('[project]\nname = "mine"\n')
    said = bench("new", "attack", "my_attack", "--builtin", f"out={tmp_path}")
    assert_one_line(said, "--builtin writes to a checkout of cavbench", f"{tmp_path} is none")
    assert files(tmp_path) == {"pyproject.toml"}


def test_an_entry_that_is_not_installed_yet_is_named_in_one_line(bench: Bench, checkout: Path, tmp_path: Path) -> None:
    bench("new", "attack", "my_attack", "--builtin", f"out={checkout}")
    for words in (("list", "my_attack"), ("run", "attack=my_attack")):
        ended = typed(checkout, tmp_path / "nothing", "-m", "cavbench", *words)
        assert ended.returncode != 0
        (line,) = ended.stderr.strip().splitlines()
        assert "it is not installed yet: pip install --no-deps -e" in line


@pytest.mark.parametrize(
    ("project", "part"),
    [
        ('[project]\nname = "cavbench"\n', "no table"),
        ('[project]\n[project.entry-points."cavbench.attacks"]\nmine = "a:B"\n', "'mine' already"),
    ],
)
def test_an_entry_needs_its_table_and_a_free_name(project: str, part: str) -> None:
    with pytest.raises(UserError, match=f"{part}.*; nothing was written"):
        with_entry(project, "cavbench.attacks", "mine", "a:B")


@pytest.mark.parametrize("after", ["", "\n", '\n[project.entry-points."x"]\nother = "c:D"\n', "[tool.x]\ny = 1\n"])
def test_an_entry_is_added_at_the_end_of_its_table(after: str) -> None:
    project = '[project]\nname = "x"\n[project.entry-points."cavbench.attacks"]\nfirst = "a:A"\n' + after
    read = tomllib.loads(with_entry(project, "cavbench.attacks", "mine", "a:B"))
    added = read["project"]["entry-points"]["cavbench.attacks"]
    assert added == {"first": "a:A", "mine": "a:B"}
    del added["mine"]
    assert read == tomllib.loads(project)


@pytest.mark.slow
def test_every_built_in_component_follows_the_rules_of_the_checkout(
    bench: Bench, checkout: Path, tmp_path: Path
) -> None:
    before, site = files(checkout), tmp_path / "site"
    for kind, on in BUILT_IN:
        said = bench("new", kind, name_of(kind, on), "--builtin", f"track={on}", f"out={checkout}")
        assert said.code == 0, said.err
    made = sorted(files(checkout) - before)
    assert len(made) == 3 * len(BUILT_IN)
    code, tests = [file for file in made if file.endswith(".py")], [file for file in made if "test_" in file]
    for words in (("check",), ("format", "--check")):
        ended = typed(checkout, site, "-m", "ruff", *words, "--no-cache", *code)
        assert ended.returncode == 0, ended.stdout
    # What `pip install --no-deps -e` reads of the checkout.
    install(site, "cavbench", entry_points(checkout), {}, version="0.1.0")
    page = "tests/docs/test_docs.py::test_every_component_has_a_page"
    pages = [f"{page}[{kind}-{name_of(kind, on)}]" for kind, on in BUILT_IN]
    ended = typed(checkout, site, "-m", "pytest", "-n", "0", "-p", "no:cacheprovider", *tests, *pages)
    assert f"{TESTS - 2 + len(BUILT_IN)} passed" in ended.stdout, ended.stdout


@pytest.mark.slow
def test_the_page_of_a_built_in_component_is_a_part_of_the_site(bench: Bench, checkout: Path, tmp_path: Path) -> None:
    site, docs = tmp_path / "site", checkout / "docs"
    for kind, on in BUILT_IN:
        bench("new", kind, name_of(kind, on), "--builtin", f"track={on}", f"out={checkout}")
    install(site, "cavbench", entry_points(checkout), {}, version="0.1.0")
    folders = ("attacks", "defenses", "victims")
    for page in docs.rglob("*.md"):
        if page.parent.name not in folders or not page.name.startswith("my_"):
            page.unlink()
    (docs / "index.md").write_text("# Index\n\n" + "".join(f"```{{pages}} {folder}\n```\n\n" for folder in folders))
    ended = typed(checkout, site, "-m", "sphinx", "-W", "-q", "docs", str(tmp_path / "built"))
    assert ended.returncode == 0, ended.stderr
    for kind, on in BUILT_IN:
        name = name_of(kind, on)
        assert "<math" in (tmp_path / "built" / f"{kind}s" / f"{name}.html").read_text()
        assert f'href="{kind}s/{name}.html">{name}</a>' in (tmp_path / "built" / "index.html").read_text()
