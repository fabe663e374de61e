"""Takes files out of packages of npm, which are read as archives while they are downloaded. npm is not needed, nothing is run.

The registry is the user's own, as npm finds it: npm_config_registry, or .npmrc in the home folder, or npm's default. Passwords
and tokens are not read.
"""

from __future__ import annotations

import gzip
import hashlib
import http.client
import os
import re
import tarfile
import urllib.error
import urllib.request
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from cavbench import bounded
from cavbench.errors import UserError, short
from cavbench.zoo.wheels import NotDownloadedError, Report

DEFAULT = "https://registry.npmjs.org/"
"""The registry of npm where nothing else is configured."""
SCHEMES = ("https://", "http://", "file://")
TIMEOUT_S = 60
MOST_TIMES, SMALL = 4, 2**20
"""A package may unpack to so many times its size and 1 MiB: what it is fetched for hardly compresses, so more is a bomb."""


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
        paths = {member: folder / f"part{number}" for number, member in enumerate(members)}
        try:
            with urllib.request.urlopen(self.address, timeout=TIMEOUT_S) as answer:
                came = _Hashed(answer, self.size, report)
                found = _unpacked(came, paths, MOST_TIMES * self.size + SMALL)
                came.drain()
        except (urllib.error.URLError, http.client.HTTPException, TimeoutError) as error:
            raise NotDownloadedError(f"{self.address}: {_reason(error)}") from error
        except (tarfile.TarError, zlib.error, EOFError, gzip.BadGzipFile, ValueError) as error:
            raise UserError(f"{self.package} cannot be read: it is not a package of npm, or a damaged one") from error
        if came.hash != self.sha256:
            raise UserError(f"{self.package} has sha256 {came.hash[:12]}…, not {self.sha256[:12]}…")
        if missing := [member for member in members if member not in found]:
            raise UserError(f"{self.package} cannot be read: it has no {missing[0]!r}")
        return list(paths.values())


def registry(scope: str = "") -> str:
    """The address of the user's registry for packages of a scope.

    Raises:
        UserError: if it is no address.
    """
    given = _configured()
    found = (scope and given.get(f"{scope}:registry")) or given.get("registry") or DEFAULT
    if not found.startswith(SCHEMES):
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


class _Hashed:
    """What a server sends, hashed while it is read; no more than was announced."""

    def __init__(self, source: IO[bytes], size: int, report: Report) -> None:
        self.source, self.size, self.report = source, size, report
        self.hasher, self.count = hashlib.sha256(), 0

    def read(self, count: int = -1) -> bytes:
        piece = self.source.read(min(bounded.CHUNK if count < 0 else count, self.size + 1 - self.count))
        self.count += len(piece)
        self.hasher.update(piece)
        self.report(self.count, self.size)
        return piece

    def drain(self) -> None:
        while self.read():
            pass

    @property
    def hash(self) -> str:
        return self.hasher.hexdigest()


class _Limited:
    """What an archive unpacks to, up to a limit."""

    def __init__(self, read: Callable[[int], bytes], most: int) -> None:
        self.inner, self.left = read, most

    def read(self, count: int) -> bytes:
        piece = self.inner(min(count, self.left + 1))
        self.left -= len(piece)
        if self.left < 0:
            raise ValueError("it unpacks to more than is allowed")
        return piece


def _unpacked(source: Any, paths: dict[str, Path], most: int) -> set[str]:
    """Write members to their files while the archive is read, and return which there were."""
    found = set()
    with (
        gzip.GzipFile(fileobj=source) as plain,
        tarfile.open(fileobj=_Limited(plain.read, most), mode="r|", bufsize=bounded.CHUNK) as archive,  # type: ignore[call-overload]
    ):
        for member in archive:
            if member.name in paths and member.isreg() and member.name not in found:
                content = archive.extractfile(member)
                assert content is not None
                with paths[member.name].open("wb") as file:
                    while piece := content.read(bounded.CHUNK):
                        file.write(piece)
                found.add(member.name)
    return found


def _reason(error: Exception) -> str:
    cause = getattr(error, "reason", error)
    return str(getattr(cause, "strerror", None) or cause or type(error).__name__)
