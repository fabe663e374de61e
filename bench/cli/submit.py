"""`bench submit` and `bench verify`: a folder that others can check, and the check."""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
from rich.text import Text

from bench.cli.audit import differences, verdict
from bench.cli.progress import RunProgress
from bench.cli.show import Report, pair_named, records_of
from bench.cli.terminal import Console
from bench.cli.words import split
from bench.errors import UserError, short
from bench.files import scratch
from bench.records import reading, store
from bench.records.schema import AUDIT
from bench.run import runner, submission
from bench.run.audit import SALTS, AuditConfig
from bench.run.config import RunConfig
from bench.run.replay import Repeated, pair_of, repeat
from bench.run.submission import Submission
from bench.scenarios import Cell, Grid, SeedBlock
from bench.statistics.unpaired import ENOUGH_SCENARIOS

SAMPLE, EPISODES = 3, 20
"""Units that are replayed, and scenarios in each cell that are drawn, if nothing else is said."""
CLOSE = 0.02
"""Largest difference of a unit's score between machines or libraries."""


def submit(words: Sequence[str], console: Console) -> None:
    """Write the submission of a pair: `PAIR out=FOLDER [results=FOLDER]`.

    Raises:
        UserError: if the pair is unknown or cannot be checked by others, or the folder cannot be written.
    """
    names, options = split(words, ("out", "results"), names=1)
    if not names or "out" not in options:
        raise UserError("name the pair and the folder: bench submit PAIR out=FOLDER")
    (pair,) = names
    results = Path(options.get("results", "results")).expanduser()
    (own, records), *_ = records_of(results, pair)
    made = submission.write(results, pair_named(pair, records), Path(options["out"]).expanduser(), own=own)
    console.print(Text(f"{made.folder}: {len(made.about['files'])} files of {made.pair}."), soft_wrap=True)
    console.print(Text(f"It was driven by: {made.about['commands']['run']}", style="dim"), soft_wrap=True)
    console.print(
        Text(
            f"Fill in {made.folder / submission.CARD}, try `bench verify {made.folder}`, and send the folder (docs/submit.md)."
        ),
        soft_wrap=True,
    )


def verify(words: Sequence[str], console: Console, report: Report) -> int:
    """Check a submission: its files, some units again, and fresh scenarios; then print its row.

    Returns:
        0 if it holds, otherwise 1.

    Raises:
        UserError: if it is no submission, a component is not installed, or an option is not allowed.
    """
    names, options = split(words, ("sample", "episodes", "salt", "audit", "out"), names=1)
    if not names:
        raise UserError("name the folder of the submission: bench verify FOLDER")
    salt, episodes = (_number(options, key) for key in ("salt", "episodes"))
    if episodes is not None and episodes < ENOUGH_SCENARIOS:
        raise UserError(f"episodes must be at least {ENOUGH_SCENARIOS}, got {episodes}: fewer are too few to compare")
    found = submission.read(Path(names[0]).expanduser())
    packages = submission.installed(found)
    console.print(
        Text(
            f"{found.pair}: all files are as described. The next steps execute the code of {', '.join(packages)}, "
            "as installed here."
        ),
        soft_wrap=True,
    )
    with _zoo_of(found):
        holds = _replayed(found, _sample(options.get("sample", str(SAMPLE))), console)
        if options.get("audit", "true") != "false":
            holds = _audited(found, salt, episodes or EPISODES, console) and holds
    report(found.track, found.records)
    if not holds:
        console.print(Text("The submission does not hold.", style="bold red"))
        return 1
    if "out" in options:
        _merge(found, Path(options["out"]).expanduser())
        console.print(
            Text(f"Its records are in {options['out']}: `bench report html=PAGE out={options['out']}` has its row.")
        )
    console.print(Text("The submission holds.", style="bold green"))
    return 0


def _number(options: dict[str, str], key: str) -> int | None:
    """A whole number; None if it is not given."""
    if key in options and not (options[key].isdecimal() and int(options[key]) < SALTS):
        raise UserError(f"{key} must be a whole number, got {short(options[key])}")
    return int(options[key]) if key in options else None


def _sample(text: str) -> int | None:
    if text == "all":
        return None
    if not text.isdecimal() or not int(text):
        raise UserError(f"sample must be all or a whole number of at least 1, got {text}")
    return int(text)


@contextmanager
def _zoo_of(found: Submission) -> Iterator[None]:
    """Load weights from the submission: they are safetensors with a hash, which execute nothing."""
    before = os.environ.get("CAVBENCH_ZOO")
    # A folder without entries if it brings none: the weights of this user must not stand in for them.
    os.environ["CAVBENCH_ZOO"] = str(found.folder / submission.ZOO)
    try:
        yield
    finally:
        if before is None:
            del os.environ["CAVBENCH_ZOO"]
        else:
            os.environ["CAVBENCH_ZOO"] = before


def _replayed(found: Submission, sample: int | None, console: Console) -> bool:
    """Drive some units of the pair again, which nobody could foresee, and print a line for each."""
    units = sorted(pc.unique(found.own["unit"]).to_pylist())
    chosen = units if sample is None else secrets.SystemRandom().sample(units, min(sample, len(units)))
    holds = True
    for number, unit in enumerate(chosen, 1):
        record = found.own.filter(pc.equal(found.own["unit"], unit)).slice(0, 1).to_pylist()[0]
        again = repeat(found.folder, record)
        said, fine = _said(again, found.track.metric)
        holds = holds and fine
        line = Text(f"replay {number} of {len(chosen)}: {again.unit}: {said}", style="" if fine else "bold red")
        console.print(line, soft_wrap=True)
    return holds


def _said(again: Repeated, metric: str) -> tuple[str, bool]:
    before, after = (pc.mean(records[metric]).as_py() for records in (again.before, again.after))
    if not again.differences:
        return "bit for bit the same", True
    scores = f"{metric} {before:.3f} recorded, {after:.3f} again; it differs in {', '.join(again.differences)}"
    if again.changed:
        return f"{scores} (changed here: {again.changed})", abs(before - after) <= CLOSE
    return f"{scores}, though nothing has changed", False


def _audited(found: Submission, salt: int | None, episodes: int, console: Console) -> bool:
    """Drive the pair on scenarios drawn now, and compare them with the submitted ones."""
    pair = pair_of(found.own.slice(0, 1).to_pylist()[0])
    world = pair.world.component
    if not world.redraws:
        console.print(Text(f"World {pair.world.name!r} has a fixed set of scenarios: it is not audited."))
        return True
    given = len(set(found.own["seed"].to_pylist()))
    if given < ENOUGH_SCENARIOS:
        console.print(Text(f"Not audited: it has {given} scenarios a cell, an audit needs {ENOUGH_SCENARIOS}."))
        return False
    seeds = sorted(set(found.own["training_seed"].to_pylist()))
    cells = [Cell(**cell) for cell in _cells(found.own)]
    values = {axis: tuple(dict.fromkeys(cell[axis] for cell in cells)) for axis in world.axes}
    salt = secrets.randbelow(SALTS) if salt is None else salt
    drawn = Grid(
        name=AUDIT,
        world=pair.world.name,
        axes=world.axes,
        values=values,
        episodes=episodes,
        first_seed=SeedBlock.AUDIT + salt,
    )
    with scratch() as folder:
        config = RunConfig(pairs=(pair,), grid=drawn, seeds=tuple(seeds), out=folder, record=0, reference=False)
        with RunProgress(Console(stderr=True)) as progress:
            units = runner.run(config, progress)
        fresh = reading.read(config.out, units, track=found.track)
    both = AuditConfig(public=replace(config, out=found.folder), drawn=config, salt=salt)
    console.print(Text(f"Fresh scenarios (salt={salt}), {drawn.episodes} a cell:"))
    return verdict(differences(both, pa.concat_tables([found.records, fresh]), found.track), found.track, console)


def _cells(records: pa.Table) -> list[dict[str, Any]]:
    return [json.loads(text) for text in pc.unique(records["cell"]).to_pylist()]


def _merge(found: Submission, out: Path) -> None:
    """Copy the records and artefacts of a submission into a results folder."""
    store.prepare(out)
    folders = [store.FOLDER, *([found.track.artefact[1]] if found.track.artefact else [])]
    for folder in folders:
        (out / folder).mkdir(exist_ok=True)
        for path in (found.folder / folder).glob("*"):
            shutil.copyfile(path, out / folder / path.name)
