"""An audit: a run on the public scenarios, and the same run on scenarios that nobody could know before."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass, replace

from cavbench.errors import UserError
from cavbench.records.schema import AUDIT
from cavbench.run.config import Start, plan_of
from cavbench.run.plan import Plan
from cavbench.scenarios import SeedBlock
from cavbench.statistics.unpaired import ENOUGH_SCENARIOS

SALTS = 2**50


@dataclass(frozen=True, kw_only=True)
class Audit:
    """The two runs of an audit, into the same results folder.

    Args:
        public: on the scenarios of the grid.
        drawn: on as many drawn scenarios of the same cells.
        salt: determines the drawn scenarios; the first of their seeds is `SeedBlock.AUDIT + salt`.
    """

    public: Plan
    drawn: Plan
    salt: int


def audit_of(words: Sequence[str], start: Start = lambda executor, modules: None) -> Audit:
    """The audit with these words: those of `bench run`, and `salt=NUMBER` to repeat or continue an audit.

    Args:
        words: options, each `key=value`.
        start: as in `cavbench.run.config.plan_of`.

    Raises:
        UserError: if an option is not allowed, or the world has a fixed set of scenarios.
    """
    salts = [word.removeprefix("salt=") for word in words if word.startswith("salt=")]
    if len(salts) > 1 or any(not salt.isdecimal() or int(salt) >= SALTS for salt in salts):
        raise UserError(
            f"salt must be one whole number from 0 to {SALTS - 1}, got {', '.join(salts)}; leave it out to draw one"
        )
    public = plan_of([word for word in words if not word.startswith("salt=")], start)
    # Each attack is compared on both sets of scenarios.
    public = replace(public, racing=frozenset())
    if public.until is not None:
        raise UserError("an audit drives as many scenarios as the grid has: leave out until")
    for pair in public.pairs:
        if not pair.world.component.redraws:
            raise UserError(f"world {pair.world.name!r} has a fixed set of scenarios: an audit cannot draw new ones")
    if public.grid.episodes < ENOUGH_SCENARIOS:
        raise UserError(f"an audit needs at least {ENOUGH_SCENARIOS} episodes per cell")
    salt = int(salts[0]) if salts else secrets.randbelow(SALTS)
    grid = replace(public.grid, name=AUDIT, first_seed=SeedBlock.AUDIT + salt)
    return Audit(public=public, drawn=replace(public, grid=grid, reference=False, record=0), salt=salt)
