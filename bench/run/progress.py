"""Progress of runs: a bar on a terminal, lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
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
from rich.progress import Task as BarTask
from rich.table import Column
from rich.text import Text

from cavbench.terminal import Console

if TYPE_CHECKING:
    from cavbench.run.forecast import Forecast
    from cavbench.run.task import Task

PRINTED_LINES = 5
"""Lines of a unit's output that are shown."""
MINUTE = 60.0


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


class LeftColumn(ProgressColumn):
    """The time that is left, by a forecast."""

    forecast: Forecast | None = None
    max_refresh = 1.0

    def render(self, task: BarTask) -> Text:
        return Text("-:--:--" if self.forecast is None else clock(self.forecast.left), style="progress.remaining")


class RunProgress(OnTerminal):
    """Shows the progress of a run (`cavbench.run.runner.RunWatcher`): a bar on a terminal, one line a minute elsewhere.

    Args:
        console: console to draw on; standard error, so that tables can be piped.
        cost: a line that says what the run costs; it is printed before the first unit is driven.
        permit: is asked with the seconds that the run takes, and may raise UserError.
        now: a clock in seconds.
    """

    def __init__(
        self,
        console: Console,
        cost: str = "",
        permit: Callable[[float], None] = lambda seconds: None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.console, self.cost, self.permit, self.now = console, cost, permit, now
        self.left = LeftColumn()
        self.bar = bar(console, MofNCompleteColumn(), left=self.left)
        self.started = self.said = now()
        self.task = self.bar.add_task("starting", total=None)
        self.total = self.done = 0
        self.working_on: dict[str, str] = {}
        self.under_way: dict[str, float] = {}

    def begin(self, *, episodes: int, finished: int, forecast: Forecast | None = None) -> None:
        self.total, self.done = episodes, finished
        self.left.forecast = forecast
        self.bar.reset(self.task, total=episodes, completed=finished, description="")
        if self.cost and finished < episodes:
            self.console.print(Text(self.cost), soft_wrap=True)
        if finished:
            self.console.print(f"{finished} of {episodes} episodes are already done", style="dim", highlight=False)
        if forecast is not None:
            # Nobody can answer while a bar is drawn.
            if self.console.is_terminal:
                self.bar.stop()
            self.permit(forecast.left)
            self.__enter__()
        self.started = self.said = self.now()

    def working(self, tasks: Sequence[Task]) -> None:
        if self.left.forecast is not None:
            self.left.forecast.working(tasks)
        names = [str(one) for task in tasks for one in task.each]
        self.working_on = {name: self.working_on.get(name, "") for name in names}
        self.under_way = {task: done for task, done in self.under_way.items() if task in self.working_on}
        self._describe()

    def preparing(self, task: str, share: float, text: str, episodes: int = 0) -> None:
        if self.left.forecast is not None:
            self.left.forecast.reached(task, share, episodes)
        self._say()
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
        if self.left.forecast is not None:
            self.left.forecast.finished(task, wall_s)
        self._advance()
        self._say(last=self.done == self.total)

    def _say(self, *, last: bool = False) -> None:
        """Print where the run is, if this is no terminal: once a minute, and at the end."""
        if self.console.is_terminal or not (last or self.now() - self.said >= MINUTE):
            return
        self.said = self.now()
        left = "" if last or self.left.forecast is None else f" | {clock(self.left.forecast.left)} left"
        working = next(iter(self.working_on), "")
        line = f"{self.done}/{self.total} episodes | {clock(self.now() - self.started)}{left}"
        line += f" | {working}" if working and not last else ""
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


def clock(seconds: float) -> str:
    """A time as H:MM:SS."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


def bar(console: Console, *counts: ProgressColumn, left: ProgressColumn | None = None) -> Progress:
    """A bar with these columns between what is done and the time; `left` is the time that is left."""
    return Progress(
        SpinnerColumn(),
        BarColumn(bar_width=16),
        *counts,
        TimeElapsedColumn(),
        TextColumn("ETA"),
        left or TimeRemainingColumn(),
        # Only the description gives way on a narrow terminal.
        TextColumn("{task.description}", markup=False, table_column=Column(ratio=1, no_wrap=True, overflow="ellipsis")),
        console=console,
        transient=True,
        expand=True,
    )
