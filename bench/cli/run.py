"""`bench run`: scores pairs on a grid, and prints their table."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pyarrow as pa
from rich.console import Console
from rich.text import Text

from bench.cli.progress import RunProgress, show_downloads
from bench.errors import UserError
from bench.plugins.track import Track, track_of
from bench.records import reading
from bench.run import runner
from bench.run.config import run_config


def run(words: Sequence[str], console: Console, report: Callable[[Track, pa.Table], None]) -> None:
    """Drive what is not driven yet, and print the table of the run.

    Args:
        words: the options.
        console: where to print.
        report: prints the table of a track, from records.

    Raises:
        UserError: for an option that cannot be read, a component that fails, or Ctrl-C.
    """
    show_downloads()
    config = run_config(words)
    with RunProgress(Console(stderr=True)) as progress:
        try:
            units = runner.run(config, progress)
        except KeyboardInterrupt:
            kept = f"{progress.done} of {progress.total} episodes are kept"
            raise UserError(f"interrupted; {kept}, and the same command goes on from there") from None
    own = track_of(config.pairs[0])
    report(own, reading.read(config.out, units, track=own))
    console.print(Text(f"Records in {config.out}: `bench show {config.out}` says what made them."), soft_wrap=True)
