"""A user's file or folder with the name of a package of cavbench is harmless, or reported in one line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from bench.shadow import PACKAGES, ROOT
from tests.framework.distributions import install

SHAPES = ("{}.py", "{}/__init__.py")
COMMAND = "import sys\nfrom cavbench import main\nif __name__ == '__main__':\n    sys.exit(main())\n"
"""The script that pip creates for the command; written here, so that the command of this tree is tested."""
TOY = ("attack=nudge", "victim=toy", "world=toy", "lanes=3", "density=1", "weather=clear,fog", "episodes=2", "seeds=0")


def python(folder: Path, *words: str | Path, path: tuple[Path | str, ...] = ()) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder, with cavbench on the import path after `path`."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (*path, ROOT))), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=300
    )


def write(path: Path, text: str = "") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", PACKAGES)
def test_a_script_gets_an_error_that_names_the_shadowing_file(name: str, shape: str, tmp_path: Path) -> None:
    write(tmp_path / shape.format(name))
    said = python(tmp_path, write(tmp_path / "script.py", "from cavbench.driving.contracts import DrivingAttack\n"))
    assert said.returncode == 1
    shadowing = tmp_path / shape.format(name).removesuffix("/__init__.py")
    assert said.stderr.splitlines()[-1] == (
        f"ImportError: {shadowing} shadows {name!r} of cavbench: rename it, or start Python in another folder"
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_import_cavbench_reports_a_users_bench_without_running_it(shape: str, tmp_path: Path) -> None:
    write(tmp_path / shape.format("bench"), "print('the benchmark of the user starts')\n")
    said = python(tmp_path, write(tmp_path / "script.py", "import cavbench\n"))
    assert said.returncode == 1
    assert said.stdout == ""
    shadowing = tmp_path / shape.format("bench").removesuffix("/__init__.py")
    assert said.stderr.splitlines()[-1].startswith(f"ImportError: {shadowing} shadows 'bench' of cavbench: ")


@pytest.mark.parametrize("name", ["bench", *PACKAGES])
def test_folders_without_modules_and_files_in_other_folders_do_not_shadow(name: str, tmp_path: Path) -> None:
    write(tmp_path / name / "mine.py")
    write(tmp_path / "lower" / f"{name}.py")
    said = python(tmp_path, "-c", "import bench, cavbench; print(cavbench.__version__ == cavbench.__version__)")
    assert (said.stdout, said.stderr) == ("True\n", "")


@pytest.mark.parametrize("name", ["bench", *PACKAGES])
def test_the_command_says_what_shadows_a_package_in_one_line(name: str, tmp_path: Path) -> None:
    write(tmp_path / f"{name}.py")
    command = write(tmp_path / "bin" / "bench", COMMAND)
    said = python(tmp_path, command, "list", path=(tmp_path,))
    assert said.returncode == 2
    assert said.stderr.startswith(f"error: {tmp_path / name}.py shadows {name!r} of cavbench: ")
    assert len(said.stderr.splitlines()) == 1


@pytest.mark.parametrize("name", PACKAGES)
def test_python_m_bench_says_what_shadows_a_package_in_one_line(name: str, tmp_path: Path) -> None:
    write(tmp_path / name / "__init__.py")
    said = python(tmp_path, "-m", "bench", "list")
    assert said.returncode == 2
    assert said.stderr.startswith(f"error: {tmp_path / name} shadows {name!r} of cavbench: ")
    assert len(said.stderr.splitlines()) == 1


def test_a_shadowed_plug_in_is_named_in_one_line(tmp_path: Path) -> None:
    site = tmp_path / "site"
    points = {"cavbench.attacks": {"mine": "my_attack:Mine"}}
    install(site, "my-attack", points, {"my_attack": "Mine = 1\n"})
    write(tmp_path / "my_attack.py")
    said = python(tmp_path, "-m", "bench", "list", "mine", path=(site,))
    assert said.returncode == 2
    (line,) = said.stderr.splitlines()
    assert f"{tmp_path / 'my_attack.py'} shadows 'my_attack' of my-attack: rename it" in line


@pytest.mark.slow
def test_the_command_and_its_workers_run_in_a_folder_with_all_these_names(tmp_path: Path, toy_folder: Path) -> None:
    for name in ("bench", *PACKAGES, "cavbench"):
        write(tmp_path / f"{name}.py", "raise RuntimeError('this file is the user\\'s own')\n")
    command = write(tmp_path / "bin" / "bench", COMMAND)
    words = ("run", *TOY, "workers=2", "record=0", "reference=false", "out=runs")
    said = python(tmp_path, command, *words, path=(toy_folder,))
    assert said.returncode == 0, said.stderr
    assert "nudge" in said.stdout
    assert len(list((tmp_path / "runs" / "episodes").glob("*.parquet"))) == 4


def test_all_packages_next_to_bench_are_checked() -> None:
    beside = {path.parent.name for path in Path(ROOT).glob("*/__init__.py")}
    assert beside - {"bench", "tests"} == set(PACKAGES)
