"""`bench run`: scores pairs on a grid, and prints a table."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from threading import Thread

import pyarrow as pa
from rich.table import Table
from rich.text import Text

from cavbench.cli.as_json import results, show_results
from cavbench.cli.gates import NOT_PASSED, Gate
from cavbench.cli.progress import show_downloads
from cavbench.core import registry
from cavbench.core.track import Track
from cavbench.errors import UnfinishedError, UserError
from cavbench.records import reading
from cavbench.run import logs, runner, stops
from cavbench.run.cost import HOUR, spoken
from cavbench.run.plan import Plan
from cavbench.run.progress import RunProgress
from cavbench.terminal import Console


def run(
    plan: Plan, console: Console, report: Callable[[Track, pa.Table], None], *, as_json: bool = False, yes: bool = False
) -> int:
    """Carry out the unfinished part of a run, print its table, and return its exit code: 3 if it does not pass its gates.

    Args:
        plan: the run.
        console: console to print to.
        report: prints the table of a track, from records.
        as_json: print one document (`cavbench.documents`) instead of tables, also where a component failed.
        yes: do not ask before a long run.

    Raises:
        UserError: after Ctrl-C, or at the end if a component failed.
    """
    gate = Gate(plan)
    show_downloads()
    aside = Console(stderr=True)
    # This process mostly waits, unless it drives itself: then what is imported meanwhile would count as the unit's doing.
    if plan.executor != "serial":
        Thread(target=_ready).start()
    with RunProgress(aside, str(plan.cost), partial(permit, aside, yes=yes)) as progress:
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
    if plan.log and records is not None:
        logs.log_pairs(plan.log, plan.out, results(plan.out, {plan.track.name: records})["pairs"])
    passed = gate.passes(records, errors, Console(stderr=True))
    if unfinished is not None:
        raise unfinished
    if not as_json:
        folder = f"Records in {plan.out}: `bench show {plan.out}` shows their configuration and provenance."
        console.print(Text(folder), soft_wrap=True)
    return 0 if passed else NOT_PASSED


def _ready() -> None:
    """Import what the end of a run needs: pyarrow asks pandas about arrays."""
    with suppress(Exception):
        import pandas  # noqa: F401

        registry.resolve(registry.REPORTS, "run", "report")


def permit(console: Console, seconds: float, *, yes: bool) -> None:
    """Ask on a terminal before a run of more than an hour.

    Raises:
        UserError: if the answer is no.
    """
    if yes or seconds < HOUR or not (console.is_terminal and sys.stdin.isatty()):
        return
    try:
        answer = console.input(f"This takes about {spoken(seconds)}. Go on? [y/N] ", markup=False)
    except (EOFError, KeyboardInterrupt):
        answer = ""
    if answer.strip().lower() not in ("y", "yes"):
        raise UserError("nothing was driven; --yes does not ask, episodes=, lanes= and seeds= make a run smaller")


def show_plan(plan: Plan, console: Console) -> None:
    """Print what a run would do, and what it costs; nothing is driven or written."""
    console.print(Text(str(plan.cost)), soft_wrap=True)
    asked, baselines = ({pair.id for pair in pairs} for pairs in (plan.pairs, plan.baselines))
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    table.add_column("pair", overflow="fold")
    table.add_column("")
    for heading in ("episodes", "CPU"):
        table.add_column(heading, justify="right")
    for pair in plan.driven:
        role = "" if pair.id in asked else "baseline" if pair.id in baselines else "control"
        episodes, seconds = plan.cost.by_pair[pair.id]
        table.add_row(Text(str(pair)), Text(role, style="dim"), str(episodes), spoken(seconds))
    console.print(table)
    for line in (*plan.skipped, *plan.broken):
        console.print(Text(line, style="yellow"), soft_wrap=True)


def _print(plan: Plan, records: pa.Table | None, console: Console, report: Callable[[Track, pa.Table], None]) -> None:
    if records is not None:
        report(plan.track, records)
    for stop in stops.read(plan.out, [pair.id for pair in plan.pairs]) if plan.until or plan.racing else ():
        console.print(Text(str(stop)), soft_wrap=True)
