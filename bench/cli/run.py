"""`bench run`: scores pairs on a grid, and prints a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pyarrow as pa
from rich.text import Text

from cavbench.cli.as_json import show_results
from cavbench.cli.progress import show_downloads
from cavbench.core.track import Track
from cavbench.errors import UnfinishedError, UserError
from cavbench.records import reading
from cavbench.run import runner, stops
from cavbench.run.plan import Plan
from cavbench.run.progress import RunProgress
from cavbench.terminal import Console


def run(plan: Plan, console: Console, report: Callable[[Track, pa.Table], None], *, as_json: bool = False) -> None:
    """Carry out the unfinished part of a run, and print its table.

    Args:
        plan: the run.
        console: console to print to.
        report: prints the table of a track, from records.
        as_json: print one document (`cavbench.documents`) instead of tables, also where a component failed.

    Raises:
        UserError: after Ctrl-C, or at the end if a component failed.
    """
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
    if as_json:
        records = {plan.track.name: reading.read(plan.out, units, track=plan.track)} if units else {}
        show_results(plan.out, records, unfinished.lines if unfinished else ())
        if unfinished is not None:
            raise unfinished
        return
    if units:
        report(plan.track, reading.read(plan.out, units, track=plan.track))
    for stop in stops.read(plan.out, [pair.id for pair in plan.pairs]) if plan.until else ():
        console.print(Text(str(stop)), soft_wrap=True)
    if unfinished is not None:
        raise unfinished
    console.print(
        Text(f"Records in {plan.out}: `bench show {plan.out}` shows their configuration and provenance."),
        soft_wrap=True,
    )
