"""A user's own comparisons beside published ones, in the same threat model and on the same scenarios."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any, get_args

from cavbench.core import registry
from cavbench.core.contracts import Access
from cavbench.core.registry import GROUPS
from cavbench.core.sources import access_of
from cavbench.leaderboard.comparisons.comparison import THREAT, Comparison

ORDER: tuple[str, ...] = get_args(Access)
Place = tuple[Any, ...]
"""Track, world and its parameters, grid, and the values of `THREAT`."""


def beside(own: Sequence[Comparison], published: Sequence[Comparison]) -> list[Comparison]:
    """Both, the first marked as a user's own.

    Where the own runs have a part of a grid, such as three of its cells, published attacks stand beside them on the cells and
    scenario seeds of that part. Under a threat model with less access, it stands if it asks for no more: what it did
    would have been allowed. A published attack that fits nothing of one's own is left out.

    Args:
        own: of a results folder.
        published: of the package.
    """
    mine = [replace(one, mine=True) for one in own]
    found = list(mine)
    for place in dict.fromkeys(_place(one) for one in mine if one.is_attacked):
        here = [one for one in mine if _place(one) == place]
        cells = {cell for one in here for cell in one.cells}
        seeds = {seed for one in here for seed in one.own.seeds}
        for other in published:
            if (
                other.is_attacked
                and _allowed(other, place)
                and cells & set(other.cells)
                and seeds & set(other.own.seeds)
            ):
                part = other.only(cells=cells, seeds=seeds)
                identity = {
                    **part.identity,
                    "grid": place[3],
                    "threat_access": place[4 + THREAT.index("threat_access")],
                }
                found.append(replace(part, identity=identity))
    return found


def _place(one: Comparison) -> Place:
    return one.track.name, *(one.identity[name] for name in ("world", "world_params", "grid", *THREAT))


def _allowed(one: Comparison, place: Place) -> bool:
    """Whether a published attack is of this track and world, and its threat model is this one but for the access."""
    track, world, params, _, *threat = place
    wanted = dict(zip(THREAT, threat, strict=True))
    same = (one.track.name, one.identity["world"], one.identity["world_params"]) == (track, world, params)
    rest = all(one.identity[name] == wanted[name] for name in THREAT if name != "threat_access")
    return same and rest and _needs(str(one.identity["attack"])) <= ORDER.index(wanted["threat_access"])


@cache
def _needs(attack: str) -> int:
    """The access that an attack declares, as a place in `ORDER`; the most where its source does not tell."""
    claims = registry.entries(GROUPS["attack"]).get(attack.partition(":")[0], ())
    return max(map(_declared, claims), default=len(ORDER) - 1)


def _declared(claim: registry.Entry) -> int:
    access = access_of(claim.target)
    return ORDER.index(access) if access in ORDER else len(ORDER) - 1
