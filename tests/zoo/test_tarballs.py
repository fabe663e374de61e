"""Files are taken out of packages of npm while these are downloaded: from a registry in a folder, and from a server."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import os
import tarfile
import threading
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from cavbench.errors import UserError
from cavbench.zoo import fetch, tarballs
from cavbench.zoo.tarballs import Tarball
from tests.command import Said

FILES = {
    "package/models/net.json": b"{}" * 50,
    "package/models/net.bin": os.urandom(70_000),
    "package/other": os.urandom(9_000),
}


def archive(files: dict[str, bytes]) -> bytes:
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w:gz") as tar:
        for name, content in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    return made.getvalue()


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def download(content: bytes, files: dict[str, bytes] = FILES) -> fetch.Download:
    """The download of two files in a package with this content."""
    names = [name for name in FILES if "net" in name]
    return fetch.Download(
        package=Tarball(package="@some/nets@1.2.0", sha256=sha256(content), size=len(content)),
        parts=tuple(
            fetch.Part(member=name, sha256=sha256(files.get(name, b"")), size=len(FILES[name])) for name in names
        ),
        licence="none",
        source="this test",
    )


@pytest.fixture
def registry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only registry, in a folder, and an empty cache."""
    for name in [name for name in os.environ if name.lower().startswith("npm_config_")]:
        monkeypatch.delenv(name)
    (tmp_path / "home").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("CAVBENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("npm_config_registry", (tmp_path / "registry").as_uri())
    (tmp_path / "registry/@some/nets/-").mkdir(parents=True)
    return tmp_path / "registry"


@pytest.fixture
def publish(registry: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    def call(content: bytes, given: fetch.Download | None = None) -> None:
        (registry / "@some/nets/-/nets-1.2.0.tgz").write_bytes(content)
        monkeypatch.setitem(fetch.DOWNLOADS, "net", given or download(content))

    return call


def test_the_files_alone_are_kept(publish: Callable[..., None], bench: Callable[..., Said], tmp_path: Path) -> None:
    content = archive(FILES)
    publish(content)
    assert " no " in next(line for line in bench("fetch").out.splitlines() if line.startswith("net "))
    assert bench("fetch", "net").out.strip() == f"net: {tmp_path / 'cache/net.json'}"
    kept = {path.name: path.read_bytes() for path in (tmp_path / "cache").iterdir()}
    assert kept == {Path(name).name: part for name, part in FILES.items() if "net" in name}
    assert " yes " in next(line for line in bench("fetch").out.splitlines() if line.startswith("net "))


def test_a_file_that_was_changed_is_fetched_again(publish: Callable[..., None], tmp_path: Path) -> None:
    publish(archive(FILES))
    path = fetch.weights("net")
    path.with_name("net.bin").write_bytes(b"")
    assert not fetch.cached("net")
    assert fetch.weights("net").with_name("net.bin").read_bytes() == FILES["package/models/net.bin"]


def without(name: str) -> dict[str, bytes]:
    return {key: content for key, content in FILES.items() if key != name}


WRONG = {
    "another package": (archive(FILES), {"sha256": "0" * 64}, "@some/nets@1.2.0 has sha256 .*, not 000000000000…"),
    "longer than announced": (
        archive(FILES),
        {"size": 50_000},
        "it is not a package of npm, or a damaged one|has sha256",
    ),
    "no such member": (archive(without("package/models/net.bin")), {}, "it has no 'package/models/net.bin'"),
    "another member": (
        archive({**FILES, "package/models/net.bin": b"else"}),
        {},
        "net.bin of @some/nets@1.2.0 has sha256",
    ),
    "no archive": (b"<html>", {}, "it is not a package of npm, or a damaged one"),
    "cut off": (archive(FILES)[:40_000], {}, "it is not a package of npm, or a damaged one"),
    "a bomb": (archive({"package/zeros": bytes(30_000_000)}), {}, "it is not a package of npm, or a damaged one"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_not_the_published_package_is_refused_and_nothing_is_kept(
    what: str, publish: Callable[..., None], tmp_path: Path
) -> None:
    content, other, words = WRONG[what]
    given = download(content)
    publish(content, dataclasses.replace(given, package=dataclasses.replace(given.package, **other)))
    with pytest.raises(UserError, match=words):
        fetch.weights("net")
    assert not list((tmp_path / "cache").iterdir())


def test_a_link_in_a_package_is_no_file(publish: Callable[..., None], tmp_path: Path) -> None:
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w:gz") as tar:
        for name in FILES:
            link = tarfile.TarInfo(name)
            link.type, link.linkname = tarfile.SYMTYPE, "/etc/hostname"
            tar.addfile(link)
    publish(made.getvalue())
    with pytest.raises(UserError, match=r"it has no 'package/models/net\.json'"):
        fetch.weights("net")


@pytest.fixture
def server(registry: Path) -> Iterator[str]:
    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *given: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(registry))) as serving:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{serving.server_port}/"
        serving.shutdown()


def test_the_registry_is_the_one_of_the_users_configuration(
    publish: Callable[..., None], server: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("npm_config_registry")
    assert tarballs.registry("@some").startswith("https://")
    (tmp_path / "home/.npmrc").write_text(
        f"registry=http://127.0.0.1:9/\n//host/:_authToken=secret\n@some:registry = {server}\n"
    )
    assert tarballs.registry() == "http://127.0.0.1:9/"
    assert tarballs.registry("@some") == server
    publish(archive(FILES))
    assert fetch.weights("net").is_file()


def test_without_a_network_or_a_package_the_error_says_what_to_type(
    publish: Callable[..., None],
    server: str,
    monkeypatch: pytest.MonkeyPatch,
    bench: Callable[..., Said],
    registry: Path,
) -> None:
    publish(archive(FILES))
    monkeypatch.setenv("npm_config_registry", "http://127.0.0.1:9/")
    said = bench("fetch", "net")
    assert said.code == 2
    address = "http://127.0.0.1:9/@some/nets/-/nets-1.2.0.tgz"
    assert said.err.endswith(
        f"error: net cannot be downloaded: {address}: Connection refused; connect to a network and run `bench fetch net`\n"
    )
    monkeypatch.setenv("npm_config_registry", server)
    (registry / "@some/nets/-/nets-1.2.0.tgz").unlink()
    assert "nets-1.2.0.tgz: File not found; connect to a network" in bench("fetch", "net").err
    monkeypatch.setenv("npm_config_registry", "here")
    assert "npm's registry is 'here', which is no address" in bench("fetch", "net").err
