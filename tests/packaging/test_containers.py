"""The Dockerfile, the dev container and the conda environment say what the Makefile and pyproject.toml say."""

from __future__ import annotations

import json
import re
import tomllib

import yaml

from tests.tree import ROOT

TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
LINES = re.sub(r"\\\n\s*", "", (ROOT / "Dockerfile").read_text()).splitlines()


def test_every_target_of_make_in_the_dockerfile_exists() -> None:
    named = re.findall(r"make ([a-z-]+)", "\n".join(line for line in LINES if not line.startswith("#")))
    assert named
    assert set(named) <= TARGETS


def test_the_images_python_is_one_that_the_package_supports() -> None:
    (version,) = re.findall(r"^FROM python:(\d\.\d+)-", "\n".join(LINES), re.M)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert f"Programming Language :: Python :: {version}" in project["classifiers"]


def test_what_an_image_copies_leaves_out_what_was_built_here() -> None:
    ignored = {line.strip("/") for line in (ROOT / ".dockerignore").read_text().splitlines()}
    assert {".venv", "build", "results", ".git"} <= ignored


def test_the_dev_container_builds_a_target_of_the_dockerfile() -> None:
    made = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text())
    assert f"AS {made['build']['target']}" in " ".join(LINES)
    assert made["postCreateCommand"].removeprefix("make ") in TARGETS


def test_the_conda_environment_installs_this_folder_with_its_constraints() -> None:
    made = yaml.safe_load((ROOT / "environment.yml").read_text())
    (pip,) = (one["pip"] for one in made["dependencies"] if isinstance(one, dict))
    assert pip == ["--constraint constraints.txt", "."]
    assert (ROOT / "constraints.txt").is_file()
    requires = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    (python,) = (one.partition("=")[2] for one in made["dependencies"] if str(one).startswith("python="))
    assert tuple(map(int, python.split("."))) >= tuple(map(int, requires.removeprefix(">=").split(".")))
