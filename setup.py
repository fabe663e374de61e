"""Lists the packages in the folders that pyproject.toml maps to packages; all else is there."""

import tomllib
from pathlib import Path

from setuptools import find_namespace_packages, setup

SETTINGS = tomllib.loads(Path(__file__).with_name("pyproject.toml").read_text(encoding="utf-8"))
FOLDERS = SETTINGS["tool"]["setuptools"]["package-dir"].items()

setup(
    packages=[
        ".".join(filter(None, (package, inner)))
        for package, folder in FOLDERS
        for inner in ("", *find_namespace_packages(folder))
    ]
)
