"""A user's files and folders may have the names of cavbench's folders."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.plugins.distributions import install_toy
from tests.tree import FOLDERS

TOY = ("attack=nudge", "victim=toy", "world=toy", "lanes=3", "density=1", "weather=clear,fog", "episodes=2", "seeds=0")


def python(folder: Path, *words: str | Path, path: tuple[Path, ...] = ()) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder, with `path` before all else on the import path."""
    given = filter(None, [*map(str, path), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(given), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=300
    )


def write(path: Path, text: str = "") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


@pytest.fixture
def crowded(tmp_path: Path) -> Path:
    """A folder with packages and modules of the user's that have the names of our folders."""
    for number, name in enumerate(FOLDERS):
        own = tmp_path / (f"{name}.py" if number % 2 else f"{name}/__init__.py")
        write(own, f"print({name!r}, 'of the user')\n")
    return tmp_path


def test_a_users_packages_are_the_ones_that_a_script_imports(crowded: Path) -> None:
    script = "import attacks, bench, envs\nfrom cavbench.attacks import none\nfrom cavbench.envs import highway\n"
    said = python(crowded, write(crowded / "script.py", script))
    assert (said.returncode, said.stderr) == (0, "")
    assert said.stdout.splitlines() == [f"{name} of the user" for name in ("attacks", "bench", "envs")]


def test_python_m_cavbench_imports_none_of_them(crowded: Path) -> None:
    said = python(crowded, "-m", "cavbench", "list", "attack")
    assert (said.returncode, said.stderr) == (0, "")
    assert "pgd" in said.stdout
    assert "of the user" not in said.stdout


@pytest.mark.slow
def test_a_run_with_worker_processes_imports_none_of_them(crowded: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    site.mkdir()
    install_toy(site)
    said = python(crowded, "-m", "cavbench", "run", *TOY, "out=results", "workers=2", path=(site,))
    assert said.returncode == 0, said.stderr
    assert "of the user" not in said.stdout + said.stderr


def test_only_one_name_is_added_to_what_can_be_imported() -> None:
    code = "import sys, cavbench, cavbench.attacks.driving.pgd; print(sorted({*sys.modules} & {*sys.argv[1:]}))"
    assert python(Path("/"), "-c", code, *FOLDERS).stdout == "[]\n"
