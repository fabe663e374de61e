"""`bench new`: its packages can be installed, follow the rules, pass their tests and can be scored."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cavbench.checks import scaffold
from cavbench.core.track import track
from cavbench.records import reading
from tests.cli.test_cli import assert_one_line
from tests.command import Said, forked, import_path
from tests.plugins.distributions import install, pip_install
from tests.run.test_third_track import POINTS as LISTENING
from tests.tree import PLUGINS

Bench = Callable[..., Said]
TOY_TRACK = PLUGINS / "toy_track.py"
EVERY = [*itertools.product(("attack", "defense", "victim"), ("driving", "detection")), ("world", "driving")]
TESTS = 15
"""Tests of all templates: two each, three of a defence of a driver."""


def name_of(kind: str, on: str) -> str:
    return f"my_{kind}_{on}"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A package of each kind and track, as `bench new` writes it."""
    folder = tmp_path_factory.mktemp("packages")
    return [scaffold.write(kind, name_of(kind, on), track=on, folder=folder / name_of(kind, on)) for kind, on in EVERY]


@pytest.fixture(scope="module")
def installed(written: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder into which pip installed the packages, outside of the environment of the tests."""
    site = tmp_path_factory.mktemp("site")
    pip_install(site, *written)
    return site


def test_new_prints_the_next_commands(bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    said = bench("new", "attack", "my_attack")
    assert said.code == 0, said.err
    for part in ("pip install -e 'cavbench-my-attack[test]'", "bench check my_attack", "bench run attack=my_attack"):
        assert part in said.out
    files = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file())
    assert files == [
        "cavbench-my-attack/README.md",
        "cavbench-my-attack/cavbench_my_attack.py",
        "cavbench-my-attack/pyproject.toml",
        "cavbench-my-attack/tests/test_my_attack.py",
    ]


def test_an_existing_folder_is_not_overwritten(bench: Bench, tmp_path: Path) -> None:
    out = f"out={tmp_path / 'package'}"
    assert bench("new", "attack", "my_attack", out).code == 0
    module = tmp_path / "package" / "cavbench_my_attack.py"
    module.write_text("mine")
    assert_one_line(bench("new", "attack", "my_attack", out), "exists and is not empty", "out=")
    assert module.read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("attack", "zo"), "attack 'zo' is already shipped by cavbench"),
        (("attack", "MyAttack"), "'MyAttack' is not a valid name for an attack: write lower-case words joined by _"),
        (("attack", "my-attack"), "'my-attack' is not a valid name for an attack"),
        (("defense", "class"), "'class' is not a valid name for a defence"),
        (("victim", "a" * 41), "at most 40 characters"),
        (("atack", "my_attack"), "unknown kind 'atack'; did you mean 'attack'?"),
        (("planet", "my_planet"), "unknown kind 'planet'; known: attack, defense, victim, world"),
        (("world", "merge"), "world 'merge' is already shipped by cavbench"),
        (
            ("world", "my_world", "track=detection"),
            "the track 'detection' has no template for a world; tracks with templates: driving",
        ),
        (("attack", "my_attack", "track=street"), "unknown track 'street'; known: detection, driving"),
        (("attack", "my_attack", "trak=driving"), "unknown option 'trak=driving'"),
        (("attack", "my_attack", "out=/proc/none/here"), "cannot be written"),
    ],
)
def test_bad_options_are_refused_in_one_line_and_nothing_is_written(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], part: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert_one_line(bench("new", *words), part)
    assert not list(tmp_path.iterdir())


def test_a_track_without_templates_is_refused_in_one_line(bench: Bench, plugins: Path, tmp_path: Path) -> None:
    install(plugins, "cavbench-listening", LISTENING, {"listening_plugin": TOY_TRACK.read_text()})
    said = bench("new", "attack", "my_attack", "track=listening", f"out={tmp_path / 'package'}")
    assert_one_line(said, "the track 'listening' has no template for an attack", "templates: detection, driving")
    assert not (tmp_path / "package").exists()


@pytest.mark.slow
def test_every_package_passes_its_own_tests(written: list[Path], installed: Path) -> None:
    environment = os.environ | {"PYTHONPATH": import_path(installed), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "pytest", "-v", "-p", "no:cacheprovider", "--import-mode=importlib", *written]
    ended = subprocess.run(command, cwd=installed, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout
    assert f"{TESTS} passed" in ended.stdout


@pytest.mark.slow
def test_an_installed_package_is_listed_checked_and_scored_in_workers(installed: Path, tmp_path: Path) -> None:
    (line,) = [line for line in forked((installed,), "list").out.splitlines() if "my_attack_driving" in line]
    assert line.split()[:2] == ["my_attack_driving", "driving"]
    checked = forked((installed,), "check", "my_attack_driving", "attack.strength=2")
    assert checked.code == 0, checked.out
    assert "0 to fix" in checked.out
    words = ("attack=my_attack_driving", "attack.strength=2", "lanes=3,4", "density=1", "weather=clear", "episodes=2")
    said = forked((installed,), "run", *words, "seeds=0", "workers=2", "reference=false", "record=0", f"out={tmp_path}")
    assert said.code == 0, said.err
    rows = [
        row
        for row in reading.read(tmp_path, track=track("driving")).to_pylist()
        if row["attack"] == "my_attack_driving"
    ]
    assert len(rows) == 4
    assert all('"strength":2.0' in row["attack_params"] for row in rows)
    assert {row["attack_shipped_by"] for row in rows} == {"cavbench-my-attack-driving 0.1.0"}
    assert all(row["queries"] > 1 and row["linf_max"] > 0 for row in rows)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "on"), EVERY)
def test_the_first_run_of_a_package_works_as_printed(installed: Path, tmp_path: Path, kind: str, on: str) -> None:
    name = name_of(kind, on)
    _, command, *words = scaffold.first_run(kind, name, on).split()
    quicker = ["seeds=0", "reference=false", "record=0", "executor=serial"]
    quicker += ["world.max_steps=30"] if on == "driving" else ["episodes=1"]
    said = forked((installed,), command, *words, *quicker, f"out={tmp_path}")
    assert said.code == 0, said.err
    rows = reading.read(tmp_path, track=track(on)).to_pylist()
    assert name in {row[kind] for row in rows}
