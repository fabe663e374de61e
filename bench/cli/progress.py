"""Progress of trainings and downloads: bars on a terminal, lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Self

from rich.progress import DownloadColumn, TextColumn

from cavbench.run.progress import OnTerminal, bar
from cavbench.terminal import Console


class TrainingProgress(OnTerminal):
    """Shows the progress of a training (`cavbench.core.contracts.Progress`): a bar on a terminal, a line every 10 % elsewhere."""

    def __init__(self, console: Console, label: str, also: Callable[[float, str], None] | None = None) -> None:
        self.console = console
        self.label = label
        self.also = also
        self.started = time.perf_counter()
        self.tenths = 0
        self.bar = bar(console, TextColumn("{task.percentage:>3.0f}%"))
        self.task = self.bar.add_task(label, total=1.0)

    def __call__(self, share: float, text: str) -> None:
        if self.also:
            self.also(share, text)
        self.bar.update(self.task, completed=share, description=f"{self.label}  {text}")
        if not self.console.is_terminal and int(share * 10) > self.tenths:
            self.tenths = int(share * 10)
            seconds = time.perf_counter() - self.started
            line = f"{self.label} | {share:.0%} | {seconds:.0f} s | {text}"
            self.console.print(line, highlight=False, markup=False, soft_wrap=True)


class DownloadProgress(OnTerminal):
    """Shows the progress of a download, called with the bytes received and in total: a bar on a terminal, one line elsewhere."""

    def __init__(self, console: Console, label: str) -> None:
        self.console = console
        self.label = label
        self.bar = bar(console, DownloadColumn())
        self.task = self.bar.add_task(label, total=None)

    def __enter__(self) -> Self:
        if not self.console.is_terminal:
            self.console.print(f"downloading {self.label}", highlight=False, markup=False)
        return super().__enter__()

    def __call__(self, done: int, total: int) -> None:
        self.bar.update(self.task, completed=done, total=total)


def show_downloads() -> None:
    """Show the progress of all later downloads on standard error."""
    from cavbench.zoo import fetch

    fetch.tell(lambda name: DownloadProgress(Console(stderr=True), name))
