"""Where the packages of `cavbench` stand in this repository; all else is in pyproject.toml."""

from setuptools import find_packages, setup

FOLDERS = {"cavbench": "bench", **{f"cavbench.{name}": name for name in ("attacks", "defenses", "envs", "leaderboard")}}

setup(
    package_dir=FOLDERS,
    packages=[
        name
        for package, folder in FOLDERS.items()
        for name in (package, *(f"{package}.{inner}" for inner in find_packages(folder)))
    ],
)
