"""The root of the repository holds what one looks for there, and nothing that a redirection left behind."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from tests.tree import FOLDERS, ROOT

KNOWN = {
    *(".ci", ".devcontainer", ".dockerignore", ".github", ".gitignore"),
    *("CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "README.md"),
    *("Dockerfile", "Makefile", "constraints.txt", "environment.yml", "locks", "pyproject.toml", "setup.py"),
    *("benchmarks", "docs", "findings", "studies", "tests"),
    *FOLDERS,
}


def test_git_tracks_nothing_unknown_in_the_root() -> None:
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("not a checkout of git")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    assert {path.partition("/")[0] for path in listed.split("\0") if path} == KNOWN
