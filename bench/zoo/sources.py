"""Source distributions on the Python package index, from which files are taken while they are downloaded.

pip is not asked to download them, because it would run their build to read their name. It is only asked where it would look:
its index, further indexes and folders (`pip config list`). Names and passwords in these addresses are not used.
"""

from __future__ import annotations

import ast
import re
import ssl
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html.parser import HTMLParser
from http.client import HTTPException
from pathlib import Path
from urllib.parse import unquote, urldefrag, urljoin, urlsplit, urlunsplit
from urllib.request import url2pathname

from cavbench import bounded
from cavbench.zoo import streams
from cavbench.zoo.wheels import NotDownloadedError, Report

DEFAULT = "https://pypi.org/simple"
"""The Python package index where nothing else is configured."""
KEYS = ("index-url", "extra-index-url", "find-links", "no-index", "cert")
"""What pip's configuration says of where packages are."""
MOST_TIMES = 10
"""An archive may unpack to so many times its size: source and scenes are text, which is compressed to a fifth."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A source distribution on the Python package index, a tar.gz archive.

    Args:
        requirement: `name==version`.
        sha256: hash of its archive.
        size: size of its archive in bytes.
    """

    requirement: str
    sha256: str
    size: int

    @property
    def title(self) -> str:
        """Its name in errors."""
        return self.requirement

    def take(self, members: Sequence[str], folder: Path, report: Report) -> list[Path]:
        """Download it, and write these members to files in a folder. Only they are kept.

        Raises:
            UserError: with the reason alone if it cannot be downloaded; if it has another hash, or no such member.
        """
        places = Places(configured())
        address = places.find(*self.requirement.split("=="))
        return streams.take(
            address,
            members,
            folder,
            report,
            title=self.title,
            kind="a source distribution",
            most_times=MOST_TIMES,
            size=self.size,
            sha256=self.sha256,
            context=places.context,
        )


def configured() -> dict[str, str]:
    """What the user's pip is told by its files and by PIP_ variables of where packages are. The environment counts most."""
    command = (sys.executable, "-m", "pip", "config", "list", "--no-input", "--disable-pip-version-check")
    said = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=False).stdout
    found: dict[str, dict[str, str]] = {"global": {}, "download": {}, ":env:": {}}
    for line in said.splitlines():
        if (entry := re.fullmatch(r"([^.]+)\.([\w-]+)=('.*'|\".*\")", line)) and entry[1] in found and entry[2] in KEYS:
            found[entry[1]][entry[2]] = str(ast.literal_eval(entry[3]))
    return found["global"] | found["download"] | found[":env:"]


class Places:
    """Where archives may be: pages of links, and folders.

    Args:
        told: pip's configuration, by key.
    """

    def __init__(self, told: dict[str, str]) -> None:
        self.told = told
        self.context = ssl.create_default_context(cafile=told["cert"]) if Path(told.get("cert", "")).is_file() else None

    def pages(self, name: str) -> Iterator[str]:
        """Addresses of pages that may have a link to an archive of this project."""
        yield from (_address(place) for place in self.told.get("find-links", "").split())
        if self.told.get("no-index", "0").lower() in {"0", "false", "no", "off", ""}:
            indexes = [self.told.get("index-url") or DEFAULT, *self.told.get("extra-index-url", "").split()]
            yield from (f"{_address(index).rstrip('/')}/{_normal(name)}/" for index in indexes)

    def find(self, name: str, version: str) -> str:
        """The address of the source archive of a version.

        Raises:
            NotDownloadedError: if no page has a link to it.
        """
        wanted, seen = _normal(f"{name}-{version}"), []
        for page in self.pages(name):
            try:
                for link in self._links(page):
                    file = unquote(urlsplit(link).path).rpartition("/")[2]
                    if file.endswith(".tar.gz") and _normal(file.removesuffix(".tar.gz")) == wanted:
                        return link
                seen.append(f"{page} has no {name}-{version}.tar.gz")
            except (urllib.error.URLError, HTTPException, OSError, ValueError) as error:
                seen.append(f"{page}: {streams.reason(error)}")
        raise NotDownloadedError(", ".join(seen) or "pip is told of no index and of no folder (PIP_NO_INDEX)")

    def _links(self, page: str) -> list[str]:
        """Where the links of a page lead; of a folder, its files or its page."""
        if page.startswith("file://"):
            folder = Path(url2pathname(urlsplit(page).path))
            if folder.is_dir() and not (folder / "index.html").is_file():
                return [path.as_uri() for path in folder.iterdir()]
            page = (folder / "index.html").as_uri() if folder.is_dir() else page
        with urllib.request.urlopen(page, timeout=streams.TIMEOUT_S, context=self.context) as answer:
            content = answer.read(bounded.TEXT + 1)
            base = answer.url
        if len(content) > bounded.TEXT:
            raise ValueError("it is larger than a page of links")
        anchors = _Anchors()
        anchors.feed(content.decode("utf-8", "replace"))
        links = [urldefrag(urljoin(base, target)).url for target in anchors.targets]
        # A page of the network leads to no file of this machine.
        return [
            link for link in links if link.startswith(streams.SCHEMES[:2] if base[:4] == "http" else streams.SCHEMES)
        ]


class _Anchors(HTMLParser):
    """The targets of the links of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.targets: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "a":
            self.targets += [value for key, value in attrs if key == "href" and value]


def _normal(name: str) -> str:
    """The name of a project or an archive as the index compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _address(place: str) -> str:
    """A place as an address: a path becomes one, and a name and password in it are left out."""
    if not place.startswith(streams.SCHEMES):
        return Path(place).expanduser().absolute().as_uri()
    parts = urlsplit(place)
    return urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))
