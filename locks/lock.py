"""Writes the locks: `python locks/lock.py`, with uv on the PATH. The versions of constraints.txt, the rest as the index has it.

A lock names every distribution that `make run` (run.txt) or `make test` (develop.txt) installs, with the hashes of all its files,
for Linux on x86-64 and Arm, macOS and Windows, and Python 3.11 and later. It names no index: pip takes the user's own.

torch has two locks: torch.txt for the build of the package index, with the libraries of NVIDIA that it needs, and torch-cpu.txt
for the CPU build. In one lock, pip would take a file whose hash the index states before one of a folder, whatever their versions.
To torch-cpu.txt only the file is added that pip takes on the machine of the writer. `locks/install_torch.py` chooses.

    python locks/lock.py                # all
    python locks/lock.py torch.txt      # some
"""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parent.parent
BUILD = re.compile(r"torch|triton|(nvidia|cuda)-.*")
"""Names of torch and of what only its CUDA build needs."""
TORCH, CPU = "torch.txt", "torch-cpu.txt"
LOCKS: dict[str, tuple[str, ...]] = {
    "build.txt": ("locks/build.in",),
    "run.txt": ("pyproject.toml", "locks/build.in"),
    TORCH: ("pyproject.toml",),
    "develop.txt": ("--extra", "dev", "pyproject.toml", "locks/build.in"),
}
HEAD = "# Written by `python locks/lock.py`. Do not edit: change pyproject.toml or constraints.txt, and run it again.\n"


def written(name: str) -> str:
    """The content of a lock, without its head."""
    how = ("--universal", "--generate-hashes", "--python-version", "3.11", "--constraint", "constraints.txt")
    plain = ("--no-header", "--no-emit-index-url", "--no-annotate", "--quiet")
    command = ("uv", "pip", "compile", *how, *plain, *LOCKS[name])
    text = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, cwd=ROOT).stdout
    # A distribution is a line that begins at the margin, with its hashes indented below it.
    parts = [part for part in re.split(r"^(?=\S)", text, flags=re.MULTILINE) if part.strip()]
    return "".join(part for part in parts if bool(BUILD.fullmatch(re.split(r"[=\[ ]", part)[0])) == (name == TORCH))


def written_for_cpu() -> str:
    """The lock of the CPU build: the hashes that it has, if they are of this version, and that of pip's choice here."""
    version = re.findall(r"^torch==(\S+)$", (ROOT / "constraints.txt").read_text(), flags=re.MULTILINE)[0] + "+cpu"
    before = (ROOT / "locks" / CPU).read_text() if (ROOT / "locks" / CPU).exists() else ""
    hashes = set(re.findall(r"sha256:(\w+)", before)) if f"=={version} " in before else set()
    with TemporaryDirectory() as folder:
        command = (
            sys.executable,
            "-m",
            "pip",
            "download",
            "--quiet",
            "--no-deps",
            "--dest",
            folder,
            f"torch=={version}",
        )
        subprocess.run(command, check=True)
        hashes |= {hashlib.sha256(path.read_bytes()).hexdigest() for path in Path(folder).iterdir()}
    return f"torch=={version} " + " ".join(f"\\\n    --hash=sha256:{value}" for value in sorted(hashes)) + "\n"


def main(names: list[str]) -> None:
    for name in names or [*LOCKS, CPU]:
        (ROOT / "locks" / name).write_text(HEAD + (written_for_cpu() if name == CPU else written(name)))
        sys.stdout.write(f"locks/{name}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
