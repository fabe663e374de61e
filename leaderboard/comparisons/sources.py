"""What can be compared: a results folder, a file of records, the published rows, or those of a git commit.

results            results:dqn+shield      the records of a folder; only those of a defended victim
published          dqn+advtrain            all published rows; one of them
HEAD~3             HEAD~3:dqn+advtrain     the published rows as they were in a commit of this repository
"""

from __future__ import annotations

import hashlib
import re
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.resources import as_file, files
from pathlib import Path, PurePosixPath

import pyarrow as pa
import pyarrow.compute as pc

from cavbench import bounded
from cavbench.errors import UserError, short
from cavbench.files import scratch
from cavbench.leaderboard.published import BASELINES, HOME
from cavbench.records import reading
from cavbench.records.columns import track_of
from cavbench.records.table import together

PUBLISHED = "published"
DATA = PurePosixPath("leaderboard", "data")
"""Where a repository has the records of its rows."""
REVISION = re.compile(r"[\w][\w./~^@{}-]*")
MOST_ROWS, LONGEST = 1000, 1000
"""Most rows of a commit, and most characters of the name of a source."""
Records = dict[str, pa.Table]


@dataclass(frozen=True)
class Source:
    """One side of a comparison.

    Args:
        name: as it was typed.
        read: its records by track.
        digests: of rows that are files, their contents' hashes by `GRID/NAME`: equal ones need not be read.
        row: the defended victim that it is reduced to, `VICTIM` or `VICTIM+DEFENCE`; empty for all.
    """

    name: str
    read: Callable[[frozenset[str]], Records]
    digests: dict[str, str] = field(default_factory=dict)
    row: str = ""

    def records(self, without: frozenset[str] = frozenset()) -> Records:
        """The records by track, of the rows that are not in `without`.

        Raises:
            UserError: if they cannot be read, or there is no such defended victim.
        """
        found = self.read(without)
        if not (self.row and found):
            return found
        kept = {name: records.filter(pc.equal(_rows(records), self.row)) for name, records in found.items()}
        if not any(records.num_rows for records in kept.values()):
            known = sorted({str(one) for records in found.values() for one in pc.unique(_rows(records)).to_pylist()})
            raise UserError(f"{self.name} has no records of {short(self.row)}; it has {', '.join(known) or 'none'}")
        return {name: records for name, records in kept.items() if records.num_rows}


def source(text: str) -> Source:
    """What a word of `bench compare` names.

    Raises:
        UserError: if it names nothing.
    """
    for name, row in ((text, ""), text.rpartition(":")[::2]) if len(text) < LONGEST else ():
        if name and (found := _named(name, text, row)):
            return found
    if text and (found := _published(text, text)):
        return found
    raise UserError(
        f"{short(text)} is no results folder, no file of records, no published row, and no commit of a repository with "
        f"{DATA}; write a folder, {PUBLISHED}, VICTIM+DEFENCE or a commit, and SOURCE:VICTIM+DEFENCE for a part of it"
    )


def _named(name: str, text: str, row: str) -> Source | None:
    path = Path(name).expanduser()
    if path.is_dir():
        return Source(text, lambda _: reading.read_all(path), row=row)
    if path.suffix == ".parquet":
        bounded.size(path, most=bounded.WEIGHTS)
        return Source(text, lambda _: {track_of(path).name: reading.read_file(path)}, row=row)
    return _published(text, row) if name == PUBLISHED else _committed(name, text, row)


def _published(text: str, row: str) -> Source | None:
    """The published rows, or those of one defended victim; None if there is none of it."""
    with as_file(files(HOME) / "data") as folder:
        paths = {
            f"{path.parent.name}/{path.stem}": path
            for path in sorted(folder.glob("*/*.parquet"))
            if path.stem != BASELINES and _is_of(path.stem, row)
        }

    def read(without: frozenset[str]) -> Records:
        return _together((path for name, path in paths.items() if name not in without), text)

    hashes = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in paths.items()}
    return Source(text, read, hashes, row) if paths else None


def _committed(revision: str, text: str, row: str) -> Source | None:
    """The rows of a commit of the repository that the current folder is in; None if there is no such commit."""
    if not REVISION.fullmatch(revision) or not (
        commit := _git("rev-parse", "-q", "--verify", f"{revision}^{{commit}}")
    ):
        return None
    top = Path(_git("rev-parse", "--show-toplevel").decode().strip())
    listed = _git("-C", str(top), "ls-tree", "-r", "-z", commit.decode().strip(), "--", str(DATA)).decode().split("\0")
    blobs: dict[str, str] = {}
    for line in filter(None, listed):
        about, _, place = line.partition("\t")
        file = PurePosixPath(place)
        if file.suffix == ".parquet" and file.stem != BASELINES and _is_of(file.stem, row):
            blobs[f"{file.parent.name}/{file.stem}"] = about.split()[2]
    if not blobs or len(blobs) > MOST_ROWS:
        raise UserError(
            f"commit {short(revision)} has no row {short(row)} in {DATA}"
            if row
            else f"commit {short(revision)} has no {DATA}"
        )

    def read(without: frozenset[str]) -> Records:
        with scratch() as folder:
            for number, (name, blob) in enumerate(blobs.items()):
                if name not in without:
                    (folder / f"{number}.parquet").write_bytes(_git("-C", str(top), "cat-file", "blob", blob))
            return _together(sorted(folder.glob("*.parquet")), text)

    hashes = {
        name: hashlib.sha256(_git("-C", str(top), "cat-file", "blob", blob)).hexdigest() for name, blob in blobs.items()
    }
    return Source(text, read, hashes, row)


def _git(*words: str) -> bytes:
    """What git says; nothing if it is missing or refuses."""
    try:
        return subprocess.run(["git", *words], capture_output=True, check=True, timeout=60).stdout
    except (OSError, subprocess.SubprocessError):
        return b""


def _together(paths: Iterator[Path] | list[Path], text: str) -> Records:
    found: dict[str, list[pa.Table]] = {}
    for path in paths:
        try:
            found.setdefault(track_of(path).name, []).append(reading.read_file(path))
        except (UserError, pa.ArrowException) as error:
            raise UserError(
                f"the records of {text} were written by another version, which cannot be read here"
            ) from error
    return {name: together(tables) for name, tables in found.items()}


def _is_of(stem: str, row: str) -> bool:
    """Whether a file is of a row; another row of the same name has a short hash behind it."""
    return not row or stem == row or re.fullmatch(re.escape(row) + r"-[0-9a-f]{8}", stem) is not None


def _rows(records: pa.Table) -> pa.ChunkedArray:
    """The name of each record's row: `VICTIM`, or `VICTIM+DEFENCE`."""
    defense, victim = records["defense"].cast(pa.string()), records["victim"].cast(pa.string())
    joined = pc.binary_join_element_wise(victim, defense, "+")
    return pc.if_else(pc.equal(defense, "none"), victim, joined)
