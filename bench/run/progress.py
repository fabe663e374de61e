"""Progress of runs: a bar on a terminal, lines elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.progress import (
    BarColumn,
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

from cavbench.terminal import Console

if TYPE_CHECKING:
    from cavbench.run.task import Task

PRINTED_LINES = 5
"""Lines of a unit's output that are shown."""


class OnTerminal:
    """A bar that is drawn within a `with` block, on a terminal only."""

    console: Console
    bar: Progress

    def __enter__(self) -> Self:
        if self.console.is_terminal:
            self.bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.console.is_terminal:
            self.bar.stop()


class RunProgress(OnTerminal):
    """Shows the progress of a run (`cavbench.run.runner.RunWatcher`): a bar on a terminal, one line per finished unit elsewhere.

    Args:
        console: console to draw on; standard error, so that tables can be piped.
    """

    def __init__(self, console: Console) -> None:
        self.console = console
        self.bar = bar(console, MofNCompleteColumn())
        self.task = self.bar.add_task("starting", total=None)
        self.total = self.done = 0
        self.working_on: dict[str, str] = {}
        self.under_way: dict[str, float] = {}

    def begin(self, *, episodes: int, finished: int) -> None:
        self.total, self.done = episodes, finished
        self.bar.reset(self.task, total=episodes, completed=finished, description="")
        if finished:
            self.console.print(f"{finished} of {episodes} episodes are already done", style="dim", highlight=False)

    def working(self, tasks: Sequence[Task]) -> None:
        self.working_on = {str(task): self.working_on.get(str(task), "") for task in tasks}
        self.under_way = {task: done for task, done in self.under_way.items() if task in self.working_on}
        self._describe()

    def preparing(self, task: str, share: float, text: str, episodes: int = 0) -> None:
        if episodes:
            self.under_way[task] = share * episodes
            self._advance()
            return
        self.working_on[task] = f" {share:.0%} {text}"
        self._describe()

    def finished(self, task: Task, wall_s: float) -> None:
        # A preparation drives no episodes.
        self.done += len(task.unit.seeds) if task.step == "drive" else 0
        self.under_way.pop(str(task), None)
        self._advance()
        if not self.console.is_terminal:
            line = f"{self.done}/{self.total} episodes | {task} | {wall_s:.1f} s"
            self.console.print(line, highlight=False, markup=False, soft_wrap=True)

    def printed(self, task: Task, lines: Sequence[str]) -> None:
        shown = [*lines[:PRINTED_LINES], *(["…"] if len(lines) > PRINTED_LINES else [])]
        for line in shown:
            self.console.print(Text(f"{task} prints: {line[:300]}", style="dim"), soft_wrap=True)

    def failed(self, line: str) -> None:
        self.console.print(Text(f"failed: {line}", style="red"), soft_wrap=True)

    def _advance(self) -> None:
        """Move the bar, also within a unit; it never moves back."""
        done = max(self.done + int(sum(self.under_way.values())), int(self.bar.tasks[0].completed))
        self.bar.update(self.task, completed=min(done, self.total))

    def _describe(self) -> None:
        if self.working_on:
            first, *others = (f"{task}{news}" for task, news in self.working_on.items())
            self.bar.update(self.task, description=f"{first} (+{len(others)})" if others else first)

    def warn(self, line: str) -> None:
        self.console.print(Text(f"warning: {line}", style="yellow"), soft_wrap=True)


def bar(console: Console, *counts: ProgressColumn) -> Progress:
    """A bar with these columns between what is done and the time."""
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
