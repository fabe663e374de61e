"""Installs the build of torch that pip takes here by itself, with the hashes of its lock.

    .venv/bin/python locks/install_torch.py

The build comes from the user's own settings of pip: the CPU build (2.13.0+cpu) from a folder or from PyTorch's index, else
that of the package index, which on Linux brings 2.2 GB of CUDA. pip puts 2.13.0+cpu before 2.13.0, but not where both have hashes
to check. So it is asked first without hashes, and nothing is downloaded but the description.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).parent.parent
PIP = (sys.executable, "-m", "pip", "install", "--quiet", "--no-deps")
ITSELF = "To take a build that you trust yourself: {python} -m pip install torch=={version}"


def pinned() -> str:
    """The version in constraints.txt."""
    return re.findall(r"^torch==(\S+)$", (ROOT / "constraints.txt").read_text(), flags=re.MULTILINE)[0]


def chosen(version: str) -> str:
    """The version of the build that pip would install: `version`, perhaps with a label such as +cpu.

    Raises:
        SystemExit: if there is none; pip has said why.
    """
    asked = (*PIP, "--dry-run", "--ignore-installed", "--report", "-", f"torch=={version}")
    told = subprocess.run(asked, check=False, stdout=subprocess.PIPE, text=True)
    if told.returncode:
        sys.exit(told.returncode)
    return str(json.loads(told.stdout)["install"][0]["metadata"]["version"])


def lock(version: str, build: str) -> Path:
    """The lock of a build.

    Raises:
        SystemExit: if there is none.
    """
    names = {version: "torch.txt", f"{version}+cpu": "torch-cpu.txt"}
    if build not in names:
        itself = ITSELF.format(python=sys.executable, version=build)
        sys.exit(f"no lock has torch {build}, the build that pip takes here. {itself}")
    return ROOT / "locks" / names[build]


def main() -> None:
    version = pinned()
    found = next(metadata.distributions(name="torch"), None)
    if found and found.version.partition("+")[0] == version:
        return
    build = chosen(version)
    if subprocess.run((*PIP, "--require-hashes", "-r", str(lock(version, build))), check=False).returncode:
        itself = ITSELF.format(python=sys.executable, version=build)
        sys.exit(f"torch {build} was not installed. {itself}")


if __name__ == "__main__":
    main()
