"""Receives a submission: copies it, and checks every file of the copy. Nothing in it is executed or unpickled.

What is checked and used afterwards is the copy, so that nobody can change it in between.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from cavbench import bounded
from cavbench.core import registry
from cavbench.core.track import Track, track
from cavbench.errors import UserError, short
from cavbench.files import scratch
from cavbench.records import validity
from cavbench.records.pages import unpacked
from cavbench.records.schema import schema
from cavbench.records.store import FOLDER
from cavbench.run.claims import invalid_floats
from cavbench.run.submission import CARD, DESCRIPTION, FORMAT, ZOO, Submission
from cavbench.scenarios.grid import MOST_EPISODES

MOST_FILES, MOST_BYTES = 20_000, 2**32
"""Most files and bytes of a submission."""
SHORT = 2**20
"""Most bytes of `CARD.md`, and of a file of records besides its rows."""
ROW = 2**14
"""Most bytes of a row, unpacked: ten times the longest of the published ones."""
KEYS = ("format", "pair", "track", "packages", "training_seeds", "commands", "environment", "files")


@contextmanager
def received(folder: Path) -> Iterator[Submission]:
    """A checked copy of a submission, deleted at the end.

    Raises:
        UserError: in one line, if it is no submission, or a file is missing, not allowed, not as described, or has records that
            could not be written by `bench run`.
    """
    with scratch() as place:
        about = _description(folder)
        own = track(about["track"])
        sums = _copied(folder, place, own)
        listed = about["files"]
        for name in sorted(sums.keys() | listed.keys()):
            if name not in listed:
                raise UserError(f"{folder / name} is not listed in {DESCRIPTION} (files)")
            if sums.get(name) != listed[name]:
                raise UserError(f"{folder / name} is missing, or not as {DESCRIPTION} says (files, sha256)")
        paths = sorted((place / FOLDER).glob("*.parquet"))
        records = {path.stem: _records(path, own, f"{FOLDER}/{path.name}") for path in paths}
        if not records:
            raise UserError(f"{folder} has no records of {short(about['pair'])}")
        for key, table in records.items():
            if others := set(table["pair"].to_pylist()) - {about["pair"]}:
                raise UserError(
                    f"{FOLDER}/{key}.parquet has records of the pair {short(min(others))}: a submission holds those of "
                    f"{short(about['pair'])} alone"
                )
        yield Submission(place, about, records, own, about["pair"])


def installed(submission: Submission) -> list[str]:
    """The packages whose code a verification executes, as installed here.

    Raises:
        UserError: if a component is not installed, or in another version.
    """
    found = {f"cavbench {metadata.version('cavbench')}"}
    records = pa.concat_tables(submission.records.values())
    for kind in registry.KINDS:
        names = [kind, f"{kind}_shipped_by"]
        for row in records.select(names).group_by(names).aggregate([]).sort_by(kind).to_pylist():
            name, wanted = row.values()
            there = _shipped_by(kind, name)
            if wanted != there:
                packages = [one.rpartition(" ") for one in wanted.split(", ")]
                # Somebody may type what a message says.
                if any(not re.fullmatch(r"[\w.+!-]+", part, re.ASCII) for one in packages for part in (one[0], one[2])):
                    raise UserError(f"{kind}_shipped_by is {short(wanted)!r}, which is no package with its version")
                code = " and ".join(short(one[0]) for one in packages)
                pinned = " ".join(short(f"{one[0]}=={one[2]}") for one in packages)
                has = f"installed is {there}" if there else "it is not installed"
                raise UserError(
                    f"{kind} {short(name)!r} is shipped by {short(wanted)}, {has}: read the code of {code} first, then "
                    f"`pip install {pinned}`; bench verify executes it (column {kind}_shipped_by)"
                )
            found.update(wanted.split(", "))
    return sorted(found)


def _shipped_by(kind: registry.Kind, name: str) -> str:
    """The packages that ship a component here, as a record has them, those of a chain together; empty if there is none."""
    with suppress(UserError):
        return registry.find(registry.GROUPS[kind], name, kind).shipped_by
    return ""


def check_weights(submission: Submission, expected: Mapping[str, object]) -> None:
    """Refuse weights that the pair does not load, and those that stand in for weights that ship with cavbench.

    Args:
        submission: the submission.
        expected: the paths in a submission of all weights and cards that the pair loads from a zoo.

    Raises:
        UserError: names the file.
    """
    from cavbench.zoo.store import SHIPPED

    given = {name for name in submission.about["files"] if name.startswith(f"{ZOO}/")}
    for name in sorted(given):
        if name not in expected:
            raise UserError(f"{DESCRIPTION} lists {name} (files), which the pair does not load")
        other = str(Path(name).with_suffix(".json" if name.endswith(".safetensors") else ".safetensors"))
        if other not in given:
            raise UserError(f"{DESCRIPTION} lists {name} (files), but not {other}")
        ships = SHIPPED / Path(name).relative_to(ZOO)
        if ships.exists() and ships.read_bytes() != (submission.folder / name).read_bytes():
            raise UserError(
                f"{name} stands in for weights that ship with cavbench: train them under another name or seed"
            )
        if name.endswith(".json") and not isinstance(bounded.read_json(submission.folder / name, name=name), dict):
            raise UserError(f"{name} is no card: it is no JSON object")


def _description(folder: Path) -> dict[str, Any]:
    """The content of `submission.json`, with values of the right types."""
    path = folder / DESCRIPTION
    if not os.path.lexists(path):
        raise UserError(f"{folder} is not a submission: it has no {DESCRIPTION}")
    about = bounded.read_json(path, links=False)
    if not isinstance(about, dict) or type(about.get("format")) is not int:
        raise UserError(f"{folder} is not a submission: {DESCRIPTION} has no format")
    if about["format"] != FORMAT:
        raise UserError(
            f"{folder} is not a submission of this version of cavbench: its format is {short(str(about['format']))}, wanted is "
            f"{FORMAT}; `bench submit` writes it again"
        )
    if odd := sorted(about.keys() ^ set(KEYS)):
        raise UserError(
            f"{DESCRIPTION} must have the keys {', '.join(KEYS)}, and no others: {short(odd[0])!r} is wrong"
        )
    for name in ("pair", "track"):
        if not isinstance(about[name], str):
            raise UserError(f"{DESCRIPTION} has a wrong {name}: it must be a text")
    sums = about["files"]
    if not isinstance(sums, dict) or any(not re.fullmatch("[0-9a-f]{64}", str(value)) for value in sums.values()):
        raise UserError(f"{DESCRIPTION} has wrong files: each needs its path and its sha256")
    return about


def _layout(own: Track) -> tuple[re.Pattern[str], re.Pattern[str]]:
    """The paths of files that a submission can have, and of their folders."""
    kinds = [rf"{FOLDER}/[0-9a-f]{{64}}\.parquet", rf"{ZOO}/[^/\\]+/seed\d+\.(safetensors|json)"]
    kinds += [rf"{re.escape(own.artefact[1])}/[0-9a-f]{{64}}\.safetensors"] if own.artefact else []
    folders = [FOLDER, ZOO, rf"{ZOO}/[^/\\]+", *([re.escape(own.artefact[1])] if own.artefact else [])]
    names = "|".join([re.escape(DESCRIPTION), re.escape(CARD), *kinds])
    return re.compile(names, re.ASCII), re.compile("|".join(folders))


def _copied(folder: Path, place: Path, own: Track) -> dict[str, str]:
    """Copy all files but the description, and return the sha256 of each that is not the card, by its path in the folder."""
    found: dict[str, str] = {}
    left = MOST_BYTES
    for name in _files(folder, own):
        if name == DESCRIPTION:
            continue
        most = SHORT if name == CARD else bounded.WEIGHTS if name.endswith(".safetensors") else bounded.TEXT
        target, hasher = place / name, hashlib.sha256()
        target.parent.mkdir(parents=True, exist_ok=True)
        with bounded.opened(folder / name, most=min(most, left), links=False) as file, target.open("xb") as copy:
            for piece in bounded.chunks(file, name=str(folder / name)):
                hasher.update(piece)
                copy.write(piece)
                left -= len(piece)
        if name != CARD:
            found[name] = hasher.hexdigest()
    return found


def _files(folder: Path, own: Track) -> list[str]:
    """The paths of all files in a folder, relative to it; others than those of a submission are refused."""
    files, folders = _layout(own)
    found: list[str] = []
    waiting, count = [""], 0
    while waiting:
        within = waiting.pop()
        try:
            with os.scandir(folder / within) as entries:
                for entry in entries:
                    count += 1
                    if count > MOST_FILES:
                        raise UserError(f"{folder} has more than {MOST_FILES} files")
                    name = f"{within}/{entry.name}" if within else entry.name
                    if entry.is_dir(follow_symlinks=False) and folders.fullmatch(name):
                        waiting.append(name)
                    elif entry.is_symlink() or not files.fullmatch(name):
                        raise UserError(
                            f"{folder / name} is not allowed in a submission: only {DESCRIPTION}, {CARD}, records "
                            f"({FOLDER}/UNIT.parquet), weights (safetensors) with their cards, and no links"
                        )
                    else:
                        found.append(name)
        except OSError as error:
            raise UserError(f"{folder / within} cannot be read: {error.strerror or error}") from None
    return sorted(found)


def _records(path: Path, own: Track, name: str) -> pa.Table:
    """The records of a file: columns, types and values as `bench run` writes them, of at most `MOST_EPISODES` rows."""
    wanted = schema(own)
    try:
        records = _read(path.read_bytes(), wanted, name).cast(wanted)
    except UserError:
        raise
    # Whatever a damaged file does to the reader.
    except (pa.ArrowException, OSError, ValueError, OverflowError, MemoryError) as error:
        raise UserError(f"{name} cannot be read: it is truncated or not Parquet ({type(error).__name__})") from None
    if problem := validity.complaint(records, own):
        raise UserError(f"{name} is invalid: {problem[1]}")
    if column := invalid_floats(records):
        raise UserError(f"{name} is invalid: {column} has a NaN")
    return records


def _read(content: bytes, wanted: pa.Schema, name: str) -> pa.Table:
    """The rows of a file, its texts as dictionaries: a few bytes can be a long text in every row."""
    with pq.ParquetFile(pa.BufferReader(content)) as file:
        found, footer = file.schema_arrow, file.metadata
    if why := _unlike(found, wanted):
        raise UserError(f"{name} {why}: it is of another version of cavbench, or was not written by it")
    if not 0 < footer.num_rows <= MOST_EPISODES:
        raise UserError(f"{name} has {footer.num_rows} rows; a unit has 1 to {MOST_EPISODES} (seed)")
    most = SHORT + ROW * footer.num_rows
    _check_size(unpacked(content, footer), most, footer.num_rows, name)
    texts = [column.name for column in wanted if pa.types.is_string(column.type)]
    with pq.ParquetFile(pa.BufferReader(content), read_dictionary=texts) as file:
        records = file.read(use_threads=False)
    records.validate(full=True)
    _check_size(sum(_length(records[column]) for column in texts), most, footer.num_rows, name)
    return records


def _check_size(size: int, most: int, rows: int, name: str) -> None:
    if size > most:
        raise UserError(
            f"{name} is refused: its {rows} rows unpack to {bounded.spelled(size)}, at most {bounded.spelled(most)} are allowed"
        )


def _length(texts: pa.ChunkedArray) -> int:
    """The bytes of a column of dictionaries as plain texts."""
    return sum(pc.sum(pc.binary_length(one.dictionary).take(one.indices)).as_py() or 0 for one in texts.chunks)


def _unlike(found: pa.Schema, wanted: pa.Schema) -> str:
    """The first column that is missing, doubled, of another type, or too much; empty if none."""
    if found.equals(wanted, check_metadata=False):
        return ""
    for name in found.names:
        if found.names.count(name) > 1:
            return f"has the column {short(name)} twice"
        if name not in wanted.names:
            return f"has a column {short(name)}"
    for column in wanted:
        if column.name not in found.names:
            return f"has no column {column.name}"
        given = found.field(column.name)
        if given.type != column.type or given.nullable != column.nullable:
            return f"has {short(str(given))} in the column {column.name}, not {column.type}"
    return "has its columns in another order"
