"""`bench run`: scores pairs on a grid, and prints a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pyarrow as pa
from rich.text import Text

from cavbench.cli.progress import RunProgress, show_downloads
from cavbench.cli.terminal import Console
from cavbench.core.track import Track, track_of
from cavbench.errors import UnfinishedError, UserError
from cavbench.records import reading
from cavbench.run import rounds, runner
from cavbench.run.config import run_config


def run(words: Sequence[str], console: Console, report: Callable[[Track, pa.Table], None]) -> None:
    """Carry out the unfinished part of a run, and print its table.

    Args:
        words: the options.
        console: console to print to.
        report: prints the table of a track, from records.

    Raises:
        UserError: if an option cannot be parsed, after Ctrl-C, or at the end if a component failed.
    """
    show_downloads()
    config = run_config(words)
    with RunProgress(Console(stderr=True)) as progress:
        for line in config.skipped:
            progress.warn(line)
        unfinished = None
        try:
            units: Sequence[str] = runner.run(config, progress)
        except UnfinishedError as error:
            unfinished, units = error, error.finished
        except KeyboardInterrupt:
            kept = f"{progress.done} of {progress.total} episodes are kept"
            raise UserError(f"interrupted; {kept}: run the same command again to continue") from None
    track = track_of(config.pairs[0])
    if units:
        report(track, reading.read(config.out, units, track=track))
    for stop in rounds.read(config.out, [pair.id for pair in config.pairs]) if config.until else ():
        console.print(Text(str(stop)), soft_wrap=True)
    if unfinished is not None:
        raise unfinished
    console.print(
        Text(f"Records in {config.out}: `bench show {config.out}` shows their configuration and provenance."),
        soft_wrap=True,
    )
