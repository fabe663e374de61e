"""The layouts of SUMO's roads, by name: each is a module with the functions of `Layout`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, cast

from cavbench.envs.sumo import crossing, motorway
from cavbench.envs.sumo.roads import Road


class Layout(Protocol):
    """What a layout says to netconvert and to a simulation."""

    def plain_network(self, roads: Sequence[Road]) -> dict[str, str]:
        """netconvert's plain XML of a road each row, by option of netconvert."""

    def routes(self, row: int) -> list[list[str]]:
        """The edges of each route, in order."""

    def stretches(self, row: int, route: int, lane: int, lanes: int) -> list[str]:
        """SUMO's lanes on which a car of a route may start in lane `lane` (from the left), one behind the other."""


LAYOUTS: Mapping[str, Layout] = {"motorway": cast(Layout, motorway), "crossing": cast(Layout, crossing)}
