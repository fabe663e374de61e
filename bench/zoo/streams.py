"""Takes files out of a tar.gz archive while it is downloaded. Nothing else of it reaches the disk, and nothing of it is run.

Only regular files with exactly the names that are asked for are kept, under names of ours. So links, devices, absolute paths and
paths with `..` do nothing.
"""

from __future__ import annotations

import gzip
import hashlib
import http.client
import tarfile
import urllib.error
import urllib.request
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from ssl import SSLContext
from typing import IO, Any

from cavbench import bounded
from cavbench.errors import UserError
from cavbench.zoo.wheels import NotDownloadedError, Report

SCHEMES = ("https://", "http://", "file://")
"""What an address of a registry begins with."""
TIMEOUT_S = 60
SMALL = 2**20


def take(
    address: str,
    members: Sequence[str],
    folder: Path,
    report: Report,
    *,
    title: str,
    kind: str,
    size: int,
    sha256: str,
    most_times: int,
    context: SSLContext | None = None,
) -> list[Path]:
    """Download an archive, and write these members to files in a folder. Only they are kept.

    Args:
        address: where the archive is.
        members: paths in the archive.
        folder: where the files are written.
        report: told how much was downloaded.
        title: name of the package in errors.
        kind: what it should be, in errors.
        size: size of the archive in bytes.
        sha256: hash of the archive.
        most_times: it may unpack to so many times its size and 1 MiB; more is a bomb.
        context: certificates that count, if not those of the system.

    Raises:
        NotDownloadedError: with the reason alone if it cannot be downloaded.
        UserError: if it has another hash, or no such member.
    """
    paths = {member: folder / f"part{number}" for number, member in enumerate(members)}
    try:
        with urllib.request.urlopen(address, timeout=TIMEOUT_S, context=context) as answer:
            came = _Hashed(answer, size, report)
            found = _unpacked(came, paths, most_times * size + SMALL)
            came.drain()
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError) as error:
        raise NotDownloadedError(f"{address}: {reason(error)}") from error
    except (tarfile.TarError, zlib.error, EOFError, gzip.BadGzipFile, ValueError) as error:
        raise UserError(f"{title} cannot be read: it is not {kind}, or a damaged one") from error
    if came.hash != sha256:
        raise UserError(f"{title} has sha256 {came.hash[:12]}…, not {sha256[:12]}…")
    if missing := [member for member in members if member not in found]:
        raise UserError(f"{title} cannot be read: it has no {missing[0]!r}")
    return list(paths.values())


def reason(error: Exception) -> str:
    """Why an address cannot be read, in a few words."""
    cause = getattr(error, "reason", error)
    return str(getattr(cause, "strerror", None) or cause or type(error).__name__)


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
            if not _is_plain(member) or member.name not in paths or member.name in found:
                continue
            content = archive.extractfile(member)
            assert content is not None
            with paths[member.name].open("wb") as file:
                while piece := content.read(bounded.CHUNK):
                    file.write(piece)
            found.add(member.name)
    return found


def _is_plain(member: tarfile.TarInfo) -> bool:
    """Whether it is a regular file. One with holes is not: they are in no byte of the archive, so its limit would not hold."""
    return member.isreg() and not member.issparse()
