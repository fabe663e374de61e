"""`bench run`: scores pairs on a grid, and prints a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pyarrow as pa
from rich.text import Text

from cavbench.cli.as_json import show_results
from cavbench.cli.gates import NOT_PASSED, Gate
from cavbench.cli.progress import show_downloads
from cavbench.core.track import Track
from cavbench.errors import UnfinishedError, UserError
from cavbench.records import reading
from cavbench.run import runner, stops
from cavbench.run.plan import Plan
from cavbench.run.progress import RunProgress
from cavbench.terminal import Console


def run(plan: Plan, console: Console, report: Callable[[Track, pa.Table], None], *, as_json: bool = False) -> int:
    """Carry out the unfinished part of a run, print its table, and return its exit code: 3 if it does not pass its gates.

    Args:
        plan: the run.
        console: console to print to.
        report: prints the table of a track, from records.
        as_json: print one document (`cavbench.documents`) instead of tables, also where a component failed.

    Raises:
        UserError: after Ctrl-C, or at the end if a component failed.
    """
    gate = Gate(plan)
    show_downloads()
    with RunProgress(Console(stderr=True)) as progress:
        for line in plan.skipped:
            progress.warn(line)
        unfinished = None
        try:
            units: Sequence[str] = runner.run(plan, progress)
        except UnfinishedError as error:
            unfinished, units = error, error.finished
        except KeyboardInterrupt:
            kept = f"{progress.done} of {progress.total} episodes are kept"
            raise UserError(f"interrupted; {kept}: run the same command again to continue") from None
    records = reading.read(plan.out, units, track=plan.track) if units else None
    errors = unfinished.lines if unfinished else ()
    if as_json:
        show_results(plan.out, {} if records is None else {plan.track.name: records}, errors)
    else:
        _print(plan, records, console, report)
    passed = gate.passes(records, errors, Console(stderr=True))
    if unfinished is not None:
        raise unfinished
    if not as_json:
        folder = f"Records in {plan.out}: `bench show {plan.out}` shows their configuration and provenance."
        console.print(Text(folder), soft_wrap=True)
    return 0 if passed else NOT_PASSED


def _print(plan: Plan, records: pa.Table | None, console: Console, report: Callable[[Track, pa.Table], None]) -> None:
    if records is not None:
        report(plan.track, records)
    for stop in stops.read(plan.out, [pair.id for pair in plan.pairs]) if plan.until else ():
        console.print(Text(str(stop)), soft_wrap=True)
