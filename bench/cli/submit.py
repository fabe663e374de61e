"""`bench submit` and `bench verify`: a folder that others can check, and the check."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
from rich.text import Text

from cavbench.cli.audit import differences, verdict
from cavbench.cli.show import Report, pair_named, records_of
from cavbench.cli.words import split
from cavbench.errors import UserError, short
from cavbench.files import scratch
from cavbench.records import reading
from cavbench.records.schema import AUDIT
from cavbench.run import claims, received, runner, submission, verification
from cavbench.run.audit import SALTS, Audit
from cavbench.run.claims import Claim
from cavbench.run.progress import RunProgress
from cavbench.run.submission import Submission
from cavbench.run.verification import Verified
from cavbench.scenarios import SeedBlock
from cavbench.statistics.unpaired import ENOUGH_SCENARIOS
from cavbench.terminal import Console

SAMPLE, EPISODES = 3, 20
"""Units that are replayed, and scenarios in each cell that are drawn, if nothing else is said."""


def submit(words: Sequence[str], console: Console) -> None:
    """Write the submission of a pair: `PAIR out=FOLDER [results=FOLDER]`.

    Raises:
        UserError: if the pair is unknown or cannot be checked by others, or the folder cannot be written.
    """
    names, options = split(words, ("out", "results"), names=1)
    if not names or "out" not in options:
        raise UserError("name the pair and the folder: bench submit PAIR out=FOLDER")
    results, out = (Path(options.get(key, "results")).expanduser() for key in ("results", "out"))
    (own, records), *_ = records_of(results, names[0])
    count = submission.write(results, pair_named(names[0], records), out, own=own)
    with received.received(out) as found:
        about = found.about
    console.print(Text(f"{out}: {count} files of {about['pair']}."), soft_wrap=True)
    console.print(Text(f"It was driven by: {about['commands']['run']}", style="dim"), soft_wrap=True)
    console.print(
        Text(f"Fill in {out / submission.CARD}, try `bench verify {out}`, and send the folder (docs/submit.md)."),
        soft_wrap=True,
    )


def verify(words: Sequence[str], console: Console, report: Report) -> int:
    """Check a submission: its files, its records, some units again, and fresh scenarios; then print its row.

    Returns:
        0 if it holds, otherwise 1.

    Raises:
        UserError: if it is no submission, a component is not installed, a record is not what its pair gives, or an option is
            not allowed.
    """
    names, options = split(words, ("sample", "episodes", "salt", "audit", "out"), names=1)
    if not names:
        raise UserError("name the folder of the submission: bench verify FOLDER")
    salt, episodes = (_number(options, key) for key in ("salt", "episodes"))
    if episodes is not None and episodes < ENOUGH_SCENARIOS:
        raise UserError(f"episodes must be at least {ENOUGH_SCENARIOS}, got {episodes}: fewer are too few to compare")
    out = Path(options["out"]).expanduser() if "out" in options else None
    sample = _sample(options.get("sample", str(SAMPLE) if out is None else "all"))
    if out is not None and sample is not None:
        raise UserError("out= takes what is driven here, which must be all of it: leave out sample, or leave out out")
    with received.received(Path(names[0]).expanduser()) as found:
        packages = received.installed(found)
        console.print(
            Text(
                f"{found.pair}: all files are as described. The next steps execute the code of {', '.join(packages)}, "
                "as installed here."
            ),
            soft_wrap=True,
        )
        claim = claims.of(list(found.records.values()))
        submission.check_description(found, claim.pair)
        received.check_weights(found, submission.weights_of(claim.pair, claim.plan.seeds))
        with _zoo_of(found), verification.staging(out, claim) as place:
            with RunProgress(Console(stderr=True)) as progress:
                verified = verification.drive(found, claim, place, progress, sample=sample, out=out)
            _print_replays(verified, console)
            why = [] if verification.hold(verified.again) else ["what was driven again differs"]
            if options.get("audit", "true") != "false":
                why += filter(None, [_audited(found, claim, verified, salt, episodes or EPISODES, console)])
            _print_row(found, verified, console, report)
            if why:
                kept = "" if out is None else f" What was driven here is in {place}; nothing was added to {out}."
                line = f"The submission does not hold: {', and '.join(why)}."
                console.print(Text.assemble((line, "bold red"), kept), soft_wrap=True)
                return 1
            if out is not None:
                added, there = verification.add(verified, place, out)
                kept = f", {there} were there already" if there else ""
                console.print(
                    Text(
                        f"{added} units that were driven here are in {out}{kept}: `bench report html=PAGE out={out}` has the row."
                    ),
                    soft_wrap=True,
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


def _print_replays(verified: Verified, console: Console) -> None:
    """A line for each unit that was driven again."""
    for number, again in enumerate(verified.again, 1):
        line = f"replay {number} of {len(verified.again)}: {again.unit}: {again.said}"
        console.print(Text(line, style="" if again.holds else "bold red"), soft_wrap=True)


def _print_row(found: Submission, verified: Verified, console: Console, report: Report) -> None:
    """The row: of what was driven here if that is all of it, otherwise as submitted, which is said."""
    report(found.track, _row(found, verified))
    if left := len(found.records) - len(verified.again):
        driven = f"{len(verified.again)} of its {len(found.records)} units were driven again"
        console.print(Text(f"The row is as submitted: {driven}, {left} were not."), soft_wrap=True)


def _row(found: Submission, verified: Verified) -> pa.Table:
    """The records of the pair: driven here if all were, otherwise as submitted; its controls are always driven here."""
    if len(verified.again) == len(found.records):
        return verified.records
    controls = verified.records.filter(pc.not_equal(verified.records["pair"], found.pair))
    return pa.concat_tables([*found.records.values(), controls])


def _audited(
    found: Submission, claim: Claim, verified: Verified, salt: int | None, episodes: int, console: Console
) -> str:
    """Drive the pair on scenarios drawn now, compare them with the submitted ones, and say what is wrong; else nothing."""
    grid, world = claim.plan.grid, claim.pair.world
    if not world.component.redraws:
        console.print(Text(f"World {world.name!r} has a fixed set of scenarios: it is not audited."))
        return ""
    if grid.episodes < ENOUGH_SCENARIOS:
        return f"it has {grid.episodes} scenarios a cell, and an audit needs {ENOUGH_SCENARIOS} (audit=false leaves it out)"
    salt = secrets.randbelow(SALTS) if salt is None else salt
    drawn = replace(grid, name=AUDIT, episodes=episodes, block=0, first_seed=SeedBlock.AUDIT + salt)
    with scratch() as folder:
        plan = replace(claim.plan, grid=drawn, out=folder, reference=False)
        with RunProgress(Console(stderr=True)) as progress:
            units = runner.run(plan, progress)
        fresh = reading.read(plan.out, units, track=found.track)
    both = Audit(public=claim.plan, drawn=plan, salt=salt)
    public = _row(found, verified)
    console.print(Text(f"Fresh scenarios (salt={salt}), {drawn.episodes} a cell:"))
    held = verdict(differences(both, pa.concat_tables([public, fresh]), found.track), found.track, console)
    return "" if held else "it scores otherwise on fresh scenarios"
