"""`bench fetch`: the published files there are, and fetching them."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.cli.progress import show_downloads
from bench.victims import fetch


def print_downloads(console: Console) -> None:
    """Every file with its size, licence and origin, and whether it is in the cache."""
    table = Table(box=None, pad_edge=False, header_style="dim")
    for column in ("name", "size", "licence", "here", "from"):
        table.add_column(column, overflow="fold")
    for name, download in fetch.DOWNLOADS.items():
        here = "yes" if fetch.cached(name) else "no"
        size = f"{download.size / 1e6:.1f} MB"
        table.add_row(Text(name, style="bold"), size, download.licence, here, Text(download.source))
    console.print(table)
    console.print(Text(f"\n`bench fetch NAME` fetches one into {fetch.cache()}.", style="dim"), soft_wrap=True)


def print_fetched(names: Sequence[str], console: Console) -> None:
    """Fetch files, and say where they are.

    Raises:
        UserError: if one is unknown (then nothing is fetched) or cannot be fetched.
    """
    show_downloads()
    for name in names:
        fetch.place(name)
    for name in names:
        console.print(Text(f"{name}: {fetch.weights(name)}"), soft_wrap=True)
