"""What `bench compare` can read: folders, files of records, published rows, and commits."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from cavbench.errors import UserError
from cavbench.leaderboard.comparisons.sources import source
from cavbench.leaderboard.comparisons.versus import compare
from tests.tree import ROOT

ROW = ROOT / "leaderboard" / "data" / "places-v1" / "fcos.parquet"


def test_a_row_is_read_by_its_name_by_its_file_and_as_a_part_of_all() -> None:
    ways = (str(ROW), f"{ROW}:fcos")
    sizes = {source(text).records()["detection"].num_rows for text in ways}
    assert len(sizes) == 1
    named = source("fcos+jpeg").records()["detection"]
    assert set(named["defense"].to_pylist()) == {"jpeg"}
    assert source("published:fcos+jpeg").records()["detection"].num_rows == named.num_rows


def test_a_part_that_is_not_there_names_those_that_are() -> None:
    with pytest.raises(UserError, match="no records of dqn; it has fcos"):
        source(f"{ROW}:dqn").records()


@pytest.mark.parametrize(
    "text", ["", ":", "nothing", "published:nothing", "--help", "-", "HEAD;ls", "x" * 5000, "a\0b"]
)
def test_what_is_nothing_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(UserError, match="is no results folder") as refused:
        source(text)
    assert len(str(refused.value)) < 500


def test_a_damaged_file_of_records_is_refused(tmp_path: Path) -> None:
    (tmp_path / "row.parquet").write_bytes(b"PAR1 nothing")
    with pytest.raises(UserError):
        source(str(tmp_path / "row.parquet")).records()


def git(folder: Path, *words: str) -> None:
    author = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    subprocess.run(["git", "-C", str(folder), *author, *words], check=True, capture_output=True)


def test_the_rows_of_two_commits_are_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "leaderboard" / "data" / "places-v1"
    data.mkdir(parents=True)
    git(tmp_path, "init", "-q")
    for number, names in enumerate((["fcos"], ["fcos", "rcnn"])):
        for name in names:
            (data / f"{name}.parquet").write_bytes(ROW.with_stem(name).read_bytes())
        git(tmp_path, "add", ".")
        git(tmp_path, "commit", "-q", "-m", str(number))
    monkeypatch.chdir(data)
    same = compare("HEAD~1", "HEAD")
    assert same.rows == ()
    assert same.left_out == ("1 row has the same records on both sides", "only HEAD has the row places-v1/rcnn")
    found = compare("HEAD~1:fcos", "HEAD:rcnn")
    assert {line.defended for line in found.rows} == {"fcos → rcnn"}
    with pytest.raises(UserError, match="has no row rcnn"):
        source("HEAD~1:rcnn")
