"""`bench certify`: proves what no attack within a threat model can change of a driver's decisions and of its score."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from cavbench.cli.progress import show_downloads
from cavbench.core.pair import Pair
from cavbench.core.track import Certified
from cavbench.errors import UserError, short
from cavbench.run.config import Start, plan_of
from cavbench.run.plan import Plan
from cavbench.statistics.estimates import share_interval
from cavbench.terminal import Console

LEAVES = 16
"""Courses of a scenario that are driven at most."""
MOST = 4096
FOR_ATTACK = "pgd"
"""The attack that is compared with the bounds where none is chosen."""


def asked(words: Sequence[str], start: Start = lambda executor, modules: None) -> tuple[Plan, int]:
    """What these words ask for: those of `bench run`, and `leaves=NUMBER`.

    Raises:
        UserError: if an option is not allowed, or a pair has no attack or no bounds.
    """
    given = [word.removeprefix("leaves=") for word in words if word.startswith("leaves=")]
    if len(given) > 1 or any(not text.isdecimal() or int(text) > MOST for text in given):
        raise UserError(f"leaves must be one whole number from 0 to {MOST}, got {short(', '.join(given))}")
    rest = [word for word in words if not word.startswith("leaves=")]
    if not any(word.startswith(("attack=", "config=")) for word in rest):
        rest.append(f"attack={FOR_ATTACK}")
    plan = plan_of(rest, start)
    if any(pair.is_clean for pair in plan.pairs):
        raise UserError(
            "the bounds are compared with an attack: leave out attack=none, or choose one such as attack=pgd"
        )
    return plan, int(given[0]) if given else LEAVES


def certify(plan: Plan, leaves: int, console: Console) -> None:
    """Certify every pair on every cell with every training seed, and print one row for each pair.

    Raises:
        UserError: if the decisions of a victim cannot be bounded, or after Ctrl-C.
    """
    show_downloads()
    table = _table()
    cells, seeds = plan.grid.cells(), list(plan.grid.seeds())
    runs = {pair: plan.seeds if pair.is_seeded else (0,) for pair in plan.pairs}
    total = sum(len(training) * len(cells) for training in runs.values())
    try:
        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("cells", total=total)
            for pair, training in runs.items():
                found = []
                for seed in training:
                    for cell in cells:
                        found.append(plan.track.certify(pair, seed, [cell] * len(seeds), seeds, leaves))
                        progress.advance(task)
                _add(table, pair, found, (len(training), len(cells), len(seeds)))
    except KeyboardInterrupt:
        raise UserError("interrupted; nothing is kept: choose fewer cells, seeds or episodes") from None
    console.print(table)
    scenarios = f"Cells: {len(cells)}, scenarios of each: {len(seeds)}"
    searched = (
        f"The certified score is over at most {leaves} courses of each scenario; where there are more it counts as 0."
        if leaves
        else "leaves=0: no certified score."
    )
    console.print(Text(f"{scenarios}. Frames are those without an attack. {searched}"), soft_wrap=True)


def _table() -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("pair", overflow="fold")
    for heading in (
        "budget",
        "proven by\nintervals",
        "by linear\nbounds",
        "changed\nby attack",
        "score,\nno attack",
        "certified\nscore",
        "given\nup",
    ):
        table.add_column(heading, justify="right")
    return table


def _add(table: Table, pair: Pair, found: Sequence[Certified], shape: tuple[int, int, int]) -> None:
    def values(name: str) -> NDArray[np.float64]:
        return np.concatenate([getattr(one, name) for one in found]).astype(float).reshape(shape)

    def score(name: str) -> str:
        if np.isnan(values(name)).any():
            return "-"
        one = share_interval(values(name))
        return f"{one.estimate:.3f}\n[{one.low:.2f}, {one.high:.2f}]"

    shares = [f"{100 * values(name).mean():.1f} %" for name in ("interval", "linear", "changed")]
    table.add_row(
        Text(str(pair)),
        f"{pair.threat.budget:g}",
        *shares,
        score("clean"),
        score("bound"),
        f"{100 * values('given_up').mean():.0f} %",
    )
