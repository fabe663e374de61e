"""An audit: a run on the public scenarios, and the same run on scenarios that nobody could know before."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass, replace

from cavbench.errors import UserError
from cavbench.records.schema import AUDIT
from cavbench.run.config import RunConfig, run_config
from cavbench.scenarios import SeedBlock
from cavbench.statistics.unpaired import ENOUGH_SCENARIOS

SALTS = 2**50


@dataclass(frozen=True, kw_only=True)
class AuditConfig:
    """The two runs of an audit, into the same results folder.

    Args:
        public: on the scenarios of the grid.
        drawn: on as many drawn scenarios of the same cells.
        salt: determines the drawn scenarios; the first of their seeds is `SeedBlock.AUDIT + salt`.
    """

    public: RunConfig
    drawn: RunConfig
    salt: int


def audit_config(words: Sequence[str]) -> AuditConfig:
    """The audit with these options: those of `bench run`, and `salt=NUMBER` to repeat or continue an audit.

    Raises:
        UserError: if an option is not allowed, or the world has a fixed set of scenarios.
    """
    salts = [word.removeprefix("salt=") for word in words if word.startswith("salt=")]
    if len(salts) > 1 or any(not salt.isdecimal() or int(salt) >= SALTS for salt in salts):
        raise UserError(
            f"salt must be one whole number from 0 to {SALTS - 1}, got {', '.join(salts)}; leave it out to draw one"
        )
    public = run_config([word for word in words if not word.startswith("salt=")])
    if public.until is not None:
        raise UserError("an audit drives as many scenarios as the grid has: leave out until")
    for pair in public.pairs:
        if not pair.world.component.redraws:
            raise UserError(f"world {pair.world.name!r} has a fixed set of scenarios: an audit cannot draw new ones")
    if public.grid.episodes < ENOUGH_SCENARIOS:
        raise UserError(f"an audit needs at least {ENOUGH_SCENARIOS} episodes per cell")
    salt = int(salts[0]) if salts else secrets.randbelow(SALTS)
    grid = replace(public.grid, name=AUDIT, first_seed=SeedBlock.AUDIT + salt)
    return AuditConfig(public=public, drawn=replace(public, grid=grid, reference=False, record=0), salt=salt)
