"""Writes the locks: `python locks/lock.py`, with uv on the PATH. The versions of constraints.txt, the rest as the index has it.

A lock names every distribution that `make run` (run.txt) or `make test` (develop.txt) installs, with the hashes of all its files,
for Linux on x86-64 and Arm, macOS and Windows, and Python 3.11 and later. It names no index: pip takes the user's own.

torch is not in it: its builds for CPU and CUDA have one version and other files, and each index offers other ones. It is
installed last, with the version of constraints.txt; what only its CUDA build needs (BUILD) comes with it.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
BUILD = re.compile(r"torch|triton|(nvidia|cuda)-.*")
LOCKS: dict[str, tuple[str, ...]] = {
    "build.txt": ("locks/build.in",),
    "run.txt": ("pyproject.toml", "locks/build.in"),
    "develop.txt": ("--extra", "dev", "pyproject.toml", "locks/build.in"),
}
HEAD = "# Written by `python locks/lock.py`. Do not edit: change pyproject.toml or constraints.txt, and run it again.\n"


def written(sources: tuple[str, ...]) -> str:
    """The content of a lock.

    Args:
        sources: what it is made from, and options of uv.
    """
    how = ("--universal", "--generate-hashes", "--python-version", "3.11", "--constraint", "constraints.txt")
    plain = ("--no-header", "--no-emit-index-url", "--no-annotate", "--quiet")
    command = ("uv", "pip", "compile", *how, *plain, *sources)
    text = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, cwd=ROOT).stdout
    # A distribution is a line that begins at the margin, with its hashes indented below it.
    parts = re.split(r"^(?=\S)", text, flags=re.MULTILINE)
    kept = [part for part in parts if part.strip() and not BUILD.fullmatch(re.split(r"[=\[ ]", part)[0])]
    return HEAD + "".join(kept)


def main() -> None:
    for name, sources in LOCKS.items():
        (ROOT / "locks" / name).write_text(written(sources))
        sys.stdout.write(f"locks/{name}\n")


if __name__ == "__main__":
    main()
