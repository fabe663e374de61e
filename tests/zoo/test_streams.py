"""What a hostile archive can hold: nothing of it reaches the disk but the files that were asked for."""

from __future__ import annotations

import hashlib
import io
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest

from cavbench.errors import UserError
from cavbench.zoo import streams

CONTENT = b"weights" * 1000
Fill = Callable[[tarfile.TarFile], None]


def add(tar: tarfile.TarFile, name: str, content: bytes = CONTENT, **fields: object) -> None:
    member = tarfile.TarInfo(name)
    member.size = len(content)
    for field, value in fields.items():
        setattr(member, field, value)
    tar.addfile(member, io.BytesIO(content))


def taken(fill: Fill, folder: Path, member: str = "net.bin") -> Path:
    """Take a member out of an archive that `fill` made, into a folder of its own."""
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w:gz", format=tarfile.PAX_FORMAT) as tar:
        fill(tar)
    content = made.getvalue()
    (folder / "it.tar.gz").write_bytes(content)
    (folder / "out").mkdir()
    (path,) = streams.take(
        (folder / "it.tar.gz").as_uri(),
        [member],
        folder / "out",
        lambda done, total: None,
        title="it",
        kind="an archive",
        size=len(content),
        sha256=hashlib.sha256(content).hexdigest(),
        most_times=4,
    )
    return path


def test_other_paths_are_never_written(tmp_path: Path) -> None:
    def fill(tar: tarfile.TarFile) -> None:
        for name in ("../escaped", "/tmp/escaped-absolute", "a/../../escaped", "other"):
            add(tar, name)
        add(tar, "net.bin")

    assert taken(fill, tmp_path).read_bytes() == CONTENT
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["it.tar.gz", "out", "part0"]
    assert not Path("/tmp/escaped-absolute").exists()


@pytest.mark.parametrize("member", ["../net.bin", "/net.bin"])
def test_a_path_that_leads_out_is_kept_under_a_name_of_ours(member: str, tmp_path: Path) -> None:
    assert taken(lambda tar: add(tar, member), tmp_path, member) == tmp_path / "out/part0"


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE, tarfile.DIRTYPE])
def test_what_is_no_regular_file_is_not_the_member(kind: bytes, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"it has no 'net\.bin'"):
        taken(lambda tar: add(tar, "net.bin", b"", type=kind, linkname="/etc/hostname"), tmp_path)


def test_a_file_with_holes_does_not_fill_the_disk(tmp_path: Path) -> None:
    """A kilobyte that says it is a terabyte of zeros, the first and the last byte of which are in the archive."""
    holes = {
        "GNU.sparse.major": "0",
        "GNU.sparse.minor": "1",
        "GNU.sparse.size": str(2**40),
        "GNU.sparse.numblocks": "1",
    }
    holes |= {"GNU.sparse.map": f"0,1,{2**40 - 1},1", "GNU.sparse.name": "net.bin"}
    with pytest.raises(UserError, match=r"it has no 'net\.bin'"):
        taken(lambda tar: add(tar, "net.bin", b"ab", pax_headers=holes), tmp_path)
    assert not list((tmp_path / "out").iterdir())


def test_the_first_of_two_members_of_a_name_counts(tmp_path: Path) -> None:
    def fill(tar: tarfile.TarFile) -> None:
        add(tar, "net.bin")
        add(tar, "net.bin", b"other")

    assert taken(fill, tmp_path).read_bytes() == CONTENT


@pytest.mark.parametrize("name", ["net.bin", "other"])
def test_a_bomb_is_refused_while_it_unpacks(name: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="it cannot be read: it is not an archive, or a damaged one"):
        taken(lambda tar: add(tar, name, bytes(30_000_000)), tmp_path)
    assert sum(path.stat().st_size for path in (tmp_path / "out").iterdir()) < 3_000_000
