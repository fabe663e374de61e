"""Progress of runs, trainings and downloads: bars on a terminal, lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.progress import (
    BarColumn,
    DownloadColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column
from rich.text import Text

from cavbench.cli.terminal import Console

if TYPE_CHECKING:
    from cavbench.run.unit import Loading, Preparation, Unit

PRINTED_LINES = 5
"""Lines of a unit's output that are shown."""


class RunProgress:
    """Shows the progress of a run (`cavbench.run.runner.RunWatcher`): a bar on a terminal, one line per finished unit elsewhere.

    Args:
        console: console to draw on; standard error, so that tables can be piped.
    """

    def __init__(self, console: Console) -> None:
        self.console = console
        self.bar = _bar(console, MofNCompleteColumn())
        self.task = self.bar.add_task("starting", total=None)
        self.total = self.done = 0
        self.working_on: dict[str, str] = {}
        self.under_way: dict[str, float] = {}

    def __enter__(self) -> Self:
        if self.console.is_terminal:
            self.bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.console.is_terminal:
            self.bar.stop()

    def begin(self, *, episodes: int, finished: int) -> None:
        self.total, self.done = episodes, finished
        self.bar.reset(self.task, total=episodes, completed=finished, description="")
        if finished:
            self.console.print(f"{finished} of {episodes} episodes are already done", style="dim", highlight=False)

    def working(self, works: Sequence[Unit | Preparation | Loading]) -> None:
        self.working_on = {str(work): self.working_on.get(str(work), "") for work in works}
        self.under_way = {work: done for work, done in self.under_way.items() if work in self.working_on}
        self._describe()

    def preparing(self, work: str, share: float, text: str, episodes: int = 0) -> None:
        if episodes:
            self.under_way[work] = share * episodes
            self._advance()
            return
        self.working_on[work] = f" {share:.0%} {text}"
        self._describe()

    def finished(self, work: Unit | Preparation, wall_s: float) -> None:
        # Only units have episodes; a preparation has none.
        self.done += len(work.seeds) if hasattr(work, "grid") else 0
        self.under_way.pop(str(work), None)
        self._advance()
        if not self.console.is_terminal:
            line = f"{self.done}/{self.total} episodes | {work} | {wall_s:.1f} s"
            self.console.print(line, highlight=False, markup=False, soft_wrap=True)

    def printed(self, work: Unit | Preparation | Loading, lines: Sequence[str]) -> None:
        shown = [*lines[:PRINTED_LINES], *(["…"] if len(lines) > PRINTED_LINES else [])]
        for line in shown:
            self.console.print(Text(f"{work} prints: {line[:300]}", style="dim"), soft_wrap=True)

    def failed(self, line: str) -> None:
        self.console.print(Text(f"failed: {line}", style="red"), soft_wrap=True)

    def _advance(self) -> None:
        """Move the bar, also within a unit; it never moves back."""
        done = max(self.done + int(sum(self.under_way.values())), int(self.bar.tasks[0].completed))
        self.bar.update(self.task, completed=min(done, self.total))

    def _describe(self) -> None:
        if self.working_on:
            first, *others = (f"{work}{news}" for work, news in self.working_on.items())
            self.bar.update(self.task, description=f"{first} (+{len(others)})" if others else first)

    def warn(self, line: str) -> None:
        self.console.print(Text(f"warning: {line}", style="yellow"), soft_wrap=True)


class TrainingProgress:
    """Shows the progress of a training (`cavbench.core.contracts.Progress`): a bar on a terminal, a line every 10 % elsewhere."""

    def __init__(self, console: Console, label: str) -> None:
        self.console = console
        self.label = label
        self.started = time.perf_counter()
        self.tenths = 0
        self.bar = _bar(console, TextColumn("{task.percentage:>3.0f}%"))
        self.task = self.bar.add_task(label, total=1.0)

    def __enter__(self) -> Self:
        if self.console.is_terminal:
            self.bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.console.is_terminal:
            self.bar.stop()

    def __call__(self, share: float, text: str) -> None:
        self.bar.update(self.task, completed=share, description=f"{self.label}  {text}")
        if not self.console.is_terminal and int(share * 10) > self.tenths:
            self.tenths = int(share * 10)
            seconds = time.perf_counter() - self.started
            line = f"{self.label} | {share:.0%} | {seconds:.0f} s | {text}"
            self.console.print(line, highlight=False, markup=False, soft_wrap=True)


class DownloadProgress:
    """Shows the progress of a download, called with the bytes received and in total: a bar on a terminal, one line elsewhere."""

    def __init__(self, console: Console, label: str) -> None:
        self.console = console
        self.label = label
        self.bar = _bar(console, DownloadColumn())
        self.task = self.bar.add_task(label, total=None)

    def __enter__(self) -> Self:
        if self.console.is_terminal:
            self.bar.start()
        else:
            self.console.print(f"downloading {self.label}", highlight=False, markup=False)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.console.is_terminal:
            self.bar.stop()

    def __call__(self, done: int, total: int) -> None:
        self.bar.update(self.task, completed=done, total=total)


def show_downloads() -> None:
    """Show the progress of all later downloads on standard error."""
    from cavbench.zoo import fetch

    fetch.tell(lambda name: DownloadProgress(Console(stderr=True), name))


def _bar(console: Console, *counts: ProgressColumn) -> Progress:
    return Progress(
        SpinnerColumn(),
        BarColumn(bar_width=16),
        *counts,
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
        # Only the description gives way on a narrow terminal.
        TextColumn("{task.description}", markup=False, table_column=Column(ratio=1, no_wrap=True, overflow="ellipsis")),
        console=console,
        transient=True,
        expand=True,
    )
