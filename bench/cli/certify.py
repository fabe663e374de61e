"""`bench certify`: proves what no attack within a threat model can change of a driver's decisions and of its score."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from cavbench import documents
from cavbench.cli.progress import show_downloads
from cavbench.core.pair import Pair
from cavbench.core.track import Certified, Track
from cavbench.errors import UserError, short
from cavbench.run.config import Start, plan_of
from cavbench.run.plan import Plan
from cavbench.statistics.estimates import Interval, share_interval
from cavbench.terminal import Console

LEAVES = 16
"""Courses of a scenario that are driven at most."""
MOST = 4096
SHARES = ("interval", "linear", "changed", "given_up")
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


@dataclass(frozen=True)
class Proof:
    """What is proven of a pair, over training seeds, cells and scenarios.

    Args:
        pair: the pair.
        interval, linear: share of the frames without an attack whose decision no attack can change, by each kind of bounds.
        changed: share of these frames in which the attack changes the decision.
        clean: score without an attack.
        bound: certified score; None where nothing was searched.
        given_up: share of the scenarios whose search was given up.
    """

    pair: Pair
    interval: float
    linear: float
    changed: float
    clean: Interval
    bound: Interval | None
    given_up: float

    @classmethod
    def of(cls, pair: Pair, found: Sequence[Certified], shape: tuple[int, int, int]) -> Proof:
        """From the scenarios of each training seed and cell; `shape` is the number of seeds, cells and scenarios."""

        def values(name: str) -> NDArray[np.float64]:
            return np.concatenate([getattr(one, name) for one in found]).astype(float).reshape(shape)

        bound, shares = values("bound"), {name: float(values(name).mean()) for name in SHARES}
        known = None if np.isnan(bound).any() else share_interval(bound)
        return cls(pair=pair, clean=share_interval(values("clean")), bound=known, **shares)


def certify(plan: Plan, leaves: int, console: Console, *, as_json: bool = False) -> None:
    """Certify every pair on every cell with every training seed, and print one row for each pair.

    Args:
        plan: what is certified.
        leaves: courses of a scenario that are driven at most; 0 for no certified score.
        console: for the table.
        as_json: print one document (`cavbench.documents`) as well.

    Raises:
        UserError: if the decisions of a victim cannot be bounded, or after Ctrl-C.
    """
    show_downloads()
    proofs: list[Proof] = []
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
                proofs.append(Proof.of(pair, found, (len(training), len(cells), len(seeds))))
    except KeyboardInterrupt:
        raise UserError("interrupted; nothing is kept: choose fewer cells, seeds or episodes") from None
    console.print(_table(proofs))
    scenarios = f"Cells: {len(cells)}, scenarios of each: {len(seeds)}"
    searched = (
        f"The certified score is over at most {leaves} courses of each scenario; where there are more it counts as 0."
        if leaves
        else "leaves=0: no certified score."
    )
    console.print(Text(f"{scenarios}. Frames are those without an attack. {searched}"), soft_wrap=True)
    if as_json:
        about = {"leaves": leaves, "cells": len(cells), "scenarios": len(seeds)}
        documents.show("certify", about | {"pairs": [_values(one, plan.track) for one in proofs]})


def _values(proof: Proof, track: Track) -> dict[str, object]:
    threat = proof.pair.threat
    own = {"pair": proof.pair.id, "track": track.name, "metric": track.metric}
    shares = {name: getattr(proof, name) for name in SHARES}
    scores = {"clean": _interval(proof.clean), "bound": _interval(proof.bound)}
    return own | {"norm": threat.norm, "budget": threat.budget} | shares | scores


def _interval(found: Interval | None) -> dict[str, float | None] | None:
    """Of one scenario there are no bounds."""
    if found is None:
        return None
    return {name: None if math.isnan(value) else value for name, value in asdict(found).items()}


def _table(proofs: Sequence[Proof]) -> Table:
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
    for proof in proofs:
        table.add_row(
            Text(str(proof.pair)),
            f"{proof.pair.threat.budget:g}",
            *(f"{100 * share:.1f} %" for share in (proof.interval, proof.linear, proof.changed)),
            _score(proof.clean),
            _score(proof.bound),
            f"{100 * proof.given_up:.0f} %",
        )
    return table


def _score(found: Interval | None) -> str:
    return "-" if found is None else f"{found.estimate:.3f}\n[{found.low:.2f}, {found.high:.2f}]"
