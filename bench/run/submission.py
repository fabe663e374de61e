"""A submission: one folder with everything that a stranger needs to check a scored pair, and nothing that can be executed."""

from __future__ import annotations

import hashlib
import itertools
import json
import shlex
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from bench import files
from bench.errors import UserError
from bench.plugins import registry
from bench.plugins.fingerprint import libraries, machine
from bench.plugins.pair import IN_PROCESS, Pair
from bench.plugins.track import Track, track
from bench.records import packing, reading
from bench.records.store import FOLDER
from bench.run.replay import pair_of
from bench.scenarios import Cell
from bench.scenarios.axes import written

FORMAT = 1
DESCRIPTION, CARD, ZOO = "submission.json", "CARD.md", "zoo"
ALLOWED = (".parquet", ".safetensors", ".json", ".md")
"""Endings of the files of a submission. All are data: records, weights, text."""
LARGEST = 2**30
"""Bytes of the largest file."""
TEMPLATE = """# {pair}

Fill this in; it stands beside the row.

- Authors:
- Paper (title, link):
- Code (link):
- Licence of code and weights:
- What was tuned, and on which seeds:
"""


@dataclass(frozen=True)
class Submission:
    """A submission that was read and whose files are as described.

    Args:
        folder: the folder.
        about: content of `submission.json`.
        records: records of the pair, its clean control and its baselines.
        track: track of the pair.
        pair: its name.
    """

    folder: Path
    about: Mapping[str, Any]
    records: pa.Table
    track: Track
    pair: str

    @property
    def own(self) -> pa.Table:
        """The records of the pair alone."""
        return self.records.filter(pc.equal(self.records["pair"], self.pair))

    @property
    def zoo(self) -> Path | None:
        """The folder with weights that do not ship with a package; None if there are none."""
        return self.folder / ZOO if (self.folder / ZOO).is_dir() else None


def write(results: Path, pair: str, out: Path, *, own: Track) -> Submission:
    """Write the submission of a pair.

    Args:
        results: results folder.
        pair: name of the pair.
        out: folder to write; it must not exist, or be empty.
        own: track of the pair.

    Raises:
        UserError: if the pair cannot be checked by others, its cells are not a whole grid, or the folder cannot be written.
    """
    every = reading.read(results, track=own)
    asked = every.filter(pc.equal(every["pair"], pair))
    first = asked.slice(0, 1).to_pylist()[0]
    _check(asked, first)
    records = _with_controls(every, asked, first, own)
    try:
        if out.exists() and any(out.iterdir()):
            raise UserError(f"{out} is not empty: choose a new folder with out=")
        (out / FOLDER).mkdir(parents=True, exist_ok=True)
        packing.copy(results, pc.unique(records["unit"]).to_pylist(), out)
        _copy_artefacts(results, records, own, out)
        for seed in pc.unique(asked["training_seed"]).to_pylist():
            _copy_weights(pair_of(first), seed, out)
        (out / CARD).write_text(TEMPLATE.format(pair=pair), encoding="utf-8")
        described = _described(asked, first, pair, out)
        with files.whole(out / DESCRIPTION) as file:
            file.write(json.dumps(described, indent=1, sort_keys=True).encode() + b"\n")
    except OSError as error:
        raise UserError(f"{out} cannot be written: {error.strerror or error}") from error
    return read(out)


def read(folder: Path) -> Submission:
    """Read a submission and check its files; nothing in it is executed or unpickled.

    Raises:
        UserError: if it is no submission, a file is missing, changed or not allowed, or a record is invalid.
    """
    about = _description(folder)
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or not (path.is_dir() or path.suffix in ALLOWED):
            raise UserError(f"{path} is not allowed in a submission: only {', '.join(ALLOWED)}, and no links")
        if path.is_file() and name not in (DESCRIPTION, CARD) and name not in about["files"]:
            raise UserError(f"{path} is not listed in {DESCRIPTION}")
    for name, sha256 in about["files"].items():
        path = folder / name
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise UserError(f"{DESCRIPTION} lists {name!r}, which is outside of the folder")
        if not path.is_file() or path.stat().st_size > LARGEST or _sha256(path) != sha256:
            raise UserError(f"{path} is missing, too large, or not as {DESCRIPTION} says (sha256)")
    own = track(about["track"])
    records = reading.read(folder, track=own)
    if about["pair"] not in pc.unique(records["pair"]).to_pylist():
        raise UserError(f"{folder} has no records of {about['pair']}")
    return Submission(folder, about, records, own, about["pair"])


def installed(submission: Submission) -> list[str]:
    """The packages whose code a verification executes, as installed here.

    Raises:
        UserError: if a component is not installed, or in another version.
    """
    found = {f"cavbench {metadata.version('cavbench')}"}
    for kind in registry.KINDS:
        for name, wanted in sorted(_distinct(submission.own, kind, f"{kind}_shipped_by")):
            package, _, version = str(wanted).rpartition(" ")
            plain = str(name).partition(":")[0]
            entries = registry.entries(registry.GROUPS[kind]).get(plain, ())
            if str(wanted) not in [entry.shipped_by for entry in entries]:
                has = f"installed is {entries[0].shipped_by}" if entries else "it is not installed"
                raise UserError(
                    f"{kind} {name!r} is shipped by {wanted}, {has}: read the code of {package} first, then "
                    f"`pip install {package}=={version}`; bench verify executes it"
                )
            found.add(str(wanted))
    return sorted(found)


def _description(folder: Path) -> dict[str, Any]:
    path = folder / DESCRIPTION
    try:
        about = json.loads(path.read_bytes()[: 2**24])
        fits = about["format"] == FORMAT and isinstance(about["files"], dict)
        fits = fits and all(isinstance(about[name], str) for name in ("pair", "track"))
    except (OSError, ValueError, KeyError, TypeError):
        fits = False
    if not fits:
        raise UserError(f"{folder} is not a submission: {DESCRIPTION} is missing, unreadable, or of another format")
    return about


def _check(asked: pa.Table, first: Mapping[str, Any]) -> None:
    """Refuse what others cannot load, and partial grids."""
    for kind in registry.KINDS:
        if first[f"{kind}_shipped_by"] == IN_PROCESS or "path" in json.loads(first[f"{kind}_params"]):
            raise UserError(
                f"{kind} {first[kind]!r} exists on your machine only: ship it as a plug-in that others can install, with its "
                "weights as safetensors (bench new victim, docs/submit.md)"
            )
    cells = [Cell(**json.loads(text)) for text in pc.unique(asked["cell"]).to_pylist()]
    values = {name: dict.fromkeys(cell[name] for cell in cells) for name in cells[0]}
    if len(list(itertools.product(*values.values()))) != len(cells):
        raise UserError("the cells of the pair are not a whole grid: drive every combination of the values on its axes")


def _with_controls(every: pa.Table, asked: pa.Table, first: Mapping[str, Any], own: Track) -> pa.Table:
    """The records of a pair with those of its clean control and its baselines."""
    pair = pair_of(first)
    wanted = {first["pair"], pair.clean().id, *(other.id for other in own.baselines(pair))}
    found = every.filter(pc.field("pair").isin(sorted(wanted)))
    if pair.clean().id not in pc.unique(found["pair"]).to_pylist():
        raise UserError("the clean control of the pair was not driven")
    return found.filter(pc.field("grid").isin(pc.unique(asked["grid"])))


def _copy_artefacts(results: Path, records: pa.Table, own: Track, out: Path) -> None:
    if not own.artefact:
        return
    noun, folder = own.artefact
    (out / folder).mkdir(exist_ok=True)
    for name in filter(None, pc.unique(records[noun]).to_pylist()):
        shutil.copyfile(results / folder / f"{name}.safetensors", out / folder / f"{name}.safetensors")


def _copy_weights(pair: Pair, seed: int, out: Path) -> None:
    """Copy the entries of the user's zoo that the pair loads; those of cavbench ship with it."""
    from bench.victims import zoo

    victim, defense, attack = pair.victim.component, pair.defense.component, pair.attack.component
    recipes = [zoo.Recipe.of(victim)] if victim.learns else []
    recipes += [zoo.Recipe.of(victim, defense)] if defense.trains else []
    recipes += [zoo.Recipe.of(victim, defense, attack)] if attack.learns else []
    for recipe in recipes:
        for path in zoo.own_files(recipe, seed):
            (out / ZOO / recipe.key).mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, out / ZOO / recipe.key / path.name)


def _described(asked: pa.Table, first: Mapping[str, Any], pair: str, out: Path) -> dict[str, Any]:
    listed = [path for path in sorted(out.rglob("*")) if path.is_file() and path.name not in (CARD, DESCRIPTION)]
    packages = sorted({str(first[f"{kind}_shipped_by"]) for kind in registry.KINDS})
    pip = [f"{package.rpartition(' ')[0]}=={package.rpartition(' ')[2]}" for package in packages]
    return {
        "format": FORMAT,
        "pair": pair,
        "track": pair_of(first).track,
        "packages": packages,
        "training_seeds": sorted(set(asked["training_seed"].to_pylist())),
        "commands": {
            "install": shlex.join(["pip", "install", *pip]),
            "run": command(asked, first),
            "verify": "bench verify FOLDER",
        },
        "environment": {"machine": machine(), "libraries": libraries()},
        "files": {path.relative_to(out).as_posix(): _sha256(path) for path in listed},
    }


def command(asked: pa.Table, first: Mapping[str, Any]) -> str:
    """The command that drives a pair as its records say."""
    from bench.victims.zoo.recipe import Part

    pair = pair_of(first)
    words = [f"{part.kind}={part.name}" for part in pair.parts]
    words += [option for part in pair.parts for option in Part.of(part.kind, part.component).options]
    if not pair.is_clean:
        columns = ("norm", "budget", "access", "queries", "share")
        words += [f"threat.{name}={_text(first[f'threat_{name}'])}" for name in columns if hasattr(pair.threat, name)]
    cells = [json.loads(text) for text in pc.unique(asked["cell"]).to_pylist()]
    words += [f"{axis}={','.join(dict.fromkeys(written(cell[axis]) for cell in cells))}" for axis in cells[0]]
    seeds = sorted(set(asked["training_seed"].to_pylist()))
    scenarios = len(set(asked["seed"].to_pylist()))
    return shlex.join(["bench", "run", *words, f"episodes={scenarios}", f"seeds={','.join(map(str, seeds))}"])


def _text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _distinct(records: pa.Table, *names: str) -> set[tuple[object, ...]]:
    rows = records.select(list(names)).group_by(list(names)).aggregate([]).to_pylist()
    return {tuple(row[name] for name in names) for row in rows}


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
