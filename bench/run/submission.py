"""A submission: one folder with everything that a stranger needs to check a scored pair, and nothing that can be executed.

It holds the records of the pair alone. Its clean control and its baselines are driven by whoever checks it.
"""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from cavbench import bounded, files
from cavbench.core import sets
from cavbench.core.chain import Chain
from cavbench.core.pair import Pair
from cavbench.core.track import Track
from cavbench.errors import UserError, short
from cavbench.identity.fingerprint import canonical
from cavbench.records import packing, reading
from cavbench.records.schema import AUDIT
from cavbench.records.store import FOLDER
from cavbench.run import claims

FORMAT = 2
"""Version of the format. 1 held the records of controls and baselines, too."""
DESCRIPTION, CARD, ZOO = "submission.json", "CARD.md", "zoo"
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
    """A submission whose files are as its description says.

    Args:
        folder: the folder.
        about: content of `submission.json`.
        records: records of the pair, by unit.
        track: track of the pair.
        pair: its name.
    """

    folder: Path
    about: Mapping[str, Any]
    records: Mapping[str, pa.Table]
    track: Track
    pair: str

    @property
    def zoo(self) -> Path:
        """The folder of weights that do not ship with a package; there is none if it brings none."""
        return self.folder / ZOO


def write(results: Path, pair: str, out: Path, *, own: Track) -> int:
    """Write the submission of a pair, and return the number of its files.

    Args:
        results: results folder.
        pair: name of the pair.
        out: folder to write; it must not exist, or be empty.
        own: track of the pair.

    Raises:
        UserError: if the pair cannot be checked by others, its cells are not a whole grid, or the folder cannot be written.
    """
    every = reading.read(results, track=own)
    asked = every.filter(pc.and_(pc.equal(every["pair"], pair), pc.not_equal(every["grid"], AUDIT)))
    if not asked.num_rows:
        raise UserError(f"{pair} was driven on the scenarios of an audit only: drive it with `bench run` first")
    claim = claims.of([asked.filter(pc.equal(asked["unit"], unit)) for unit in pc.unique(asked["unit"]).to_pylist()])
    try:
        if out.exists() and any(out.iterdir()):
            raise UserError(f"{out} is not empty: choose a new folder with out=")
        (out / FOLDER).mkdir(parents=True, exist_ok=True)
        packing.copy(results, pc.unique(asked["unit"]).to_pylist(), out)
        _copy_artefacts(results, asked, own, out)
        for name, path in weights_of(claim.pair, claim.plan.seeds).items():
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            if path is not None:
                shutil.copyfile(path, out / name)
        (out / CARD).write_text(TEMPLATE.format(pair=pair), encoding="utf-8")
        listed = [path for path in sorted(out.rglob("*")) if path.is_file() and path.name != CARD]
        sums = {path.relative_to(out).as_posix(): bounded.sha256(path, most=bounded.WEIGHTS) for path in listed}
        with files.whole(out / DESCRIPTION) as file:
            file.write(json.dumps(described(asked, claim.pair, sums), indent=1, sort_keys=True).encode() + b"\n")
    except OSError as error:
        raise UserError(f"{out} cannot be written: {error.strerror or error}") from error
    return len(sums)


def described(records: pa.Table, pair: Pair, sums: Mapping[str, str]) -> dict[str, Any]:
    """The content of `submission.json`.

    Args:
        records: of the pair.
        pair: the pair.
        sums: the sha256 of every file, by its path in the folder.
    """
    # A chain is shipped by several.
    packages = sorted({package for part in pair.parts for package in part.shipped_by.split(", ")})
    pip = [f"{package.rpartition(' ')[0]}=={package.rpartition(' ')[2]}" for package in packages]
    return {
        "format": FORMAT,
        "pair": pair.id,
        "track": pair.track,
        "packages": packages,
        "training_seeds": sorted(set(records["training_seed"].to_pylist())),
        "commands": {
            "install": shlex.join(["pip", "install", *pip]),
            "run": command(records, pair),
            "verify": "bench verify FOLDER",
        },
        "environment": {
            "machines": sorted(set(records["machine"].to_pylist())),
            "libraries": [json.loads(text) for text in sorted(set(records["libraries"].to_pylist()))],
        },
        "files": dict(sums),
    }


def check_description(found: Submission, pair: Pair) -> None:
    """Compare the description of a submission with what its records and its files say.

    Raises:
        UserError: names the first key that differs.
    """
    expected = described(pa.concat_tables(found.records.values()), pair, found.about["files"])
    for key, given, wanted in _differing(found.about, expected, ""):
        raise UserError(
            f"{DESCRIPTION} says {key} = {_shown(given)}, the records of the submission say {_shown(wanted)}"
        )


_ABSENT = object()


def _differing(given: object, wanted: object, key: str) -> Iterator[tuple[str, object, object]]:
    if isinstance(given, Mapping) and isinstance(wanted, Mapping):
        for name in sorted(given.keys() | wanted.keys()):
            inner = f"{key}.{name}" if key else name
            yield from _differing(given.get(name, _ABSENT), wanted.get(name, _ABSENT), inner)
    # As text: in Python, 1, 1.0 and True are equal.
    elif given is _ABSENT or wanted is _ABSENT or canonical(given) != canonical(wanted):
        yield key, given, wanted


def _shown(value: object) -> str:
    return "nothing" if value is _ABSENT else short(canonical(value))


def weights_of(pair: Pair, training_seeds: Sequence[int]) -> dict[str, Path | None]:
    """The weights and cards that a pair loads from a zoo, by their paths in a submission, with those of the user's zoo."""
    from cavbench import zoo

    victim, defense, attack = pair.victim.component, pair.defense.component, pair.attack.component
    recipes = [zoo.Recipe.of(victim)] if victim.learns else []
    links = defense.links if isinstance(defense, Chain) else (defense,)
    # A detector from elsewhere has no name in a zoo: networks that serve all victims stand around it.
    with suppress(UserError):
        recipes += [zoo.Recipe.of(victim, link) for link in links if link.learns]
    recipes += [zoo.Recipe.of(victim, defense, attack)] if attack.learns else []
    # A detector is of a training seed of its own; those of the run are of its patches.
    known = [getattr(part, "trained", None) for part in (victim, attack, *links)]
    trained = {seed for seed in known if isinstance(seed, int)}
    found: dict[str, Path | None] = {}
    for recipe in recipes:
        for seed in sorted({*training_seeds, *trained}):
            there = {path.suffix: path for path in zoo.own_files(recipe, seed)}
            for suffix in (".safetensors", ".json"):
                found[f"{ZOO}/{recipe.key}/seed{seed}{suffix}"] = there.get(suffix)
    return found


def _copy_artefacts(results: Path, records: pa.Table, own: Track, out: Path) -> None:
    if not own.artefact:
        return
    noun, folder = own.artefact
    for name in filter(None, pc.unique(records[noun]).to_pylist()):
        (out / folder).mkdir(exist_ok=True)
        shutil.copyfile(results / folder / f"{name}.safetensors", out / folder / f"{name}.safetensors")


def command(records: pa.Table, pair: Pair) -> str:
    """The command that drives a pair as its records say."""
    from cavbench.zoo.recipe import Part

    words = [f"{part.kind}={part.name}" for part in pair.parts]
    words += [option for part in pair.parts for option in Part.of(part.kind, part.component).options]
    if not pair.is_clean:
        columns = ("norm", "budget", "access", "queries", "share")
        allowed = pair.threat.columns | {"threat_norm": pair.threat.norm}
        words += [f"threat.{name}={_text(allowed[f'threat_{name}'])}" for name in columns if hasattr(pair.threat, name)]
        words += [f"threat.{word}" for word in sets.words(pair.threat)]
    cells = [json.loads(text) for text in pc.unique(records["cell"]).to_pylist()]
    words += [f"{axis}={','.join(map(_text, sorted({cell[axis] for cell in cells})))}" for axis in cells[0]]
    seeds = sorted(set(records["training_seed"].to_pylist()))
    scenarios = len(set(records["seed"].to_pylist()))
    return shlex.join(["bench", "run", *words, f"episodes={scenarios}", f"seeds={','.join(map(str, seeds))}"])


def _text(value: object) -> str:
    short = f"{value:g}" if isinstance(value, float) else str(value)
    return short if not isinstance(value, float) or float(short) == value else repr(value)
