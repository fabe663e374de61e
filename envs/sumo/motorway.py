"""A motorway with an on-ramp, for netconvert: one for each episode of a batch, all in the same place.

Roads that have no junction in common do not know each other, so the place of an episode in its batch changes no number.
SUMO's y grows to the left, and 0 is the left edge of the motorway. In cavbench y grows to the right, and the centre of lane i,
counted from the left, is at 4 i m.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from cavbench.envs.highway.dynamics import LANE_WIDTH
from cavbench.envs.sumo.roads import Road, edge

START = 300.0
"""Where the front bumper of the ego starts, in m along the motorway."""
MERGE, MERGE_LENGTH = 500.0, 200.0
"""Where the ramp meets the motorway, and the length of its lane beside it, in m."""
LENGTH = 2500.0
"""Farther than a car drives in an episode: 40 m/s for 30 s from the last car ahead."""
RAMP_LENGTH, RAMP_STRAIGHT, RAMP_ASIDE = 450.0, 100.0, 36.0
"""Length of the ramp before it meets the motorway, its part beside the motorway, and how far off it begins, in m."""
SPEED_LIMIT = 40.0
"""m/s; each car has a speed of its own that it wants to drive."""

THROUGH = ("before", "merge", "after")
"""The stretches of the motorway, in order."""
RAMP = "ramp"
ON_MOTORWAY, ON_RAMP = range(2)
"""Numbers of the routes."""


def lane_number(name: str, lane: int, lanes: int) -> int:
    """SUMO's number of lane `lane` (from the left) of a stretch: it counts from the right, and the ramp's lane is there, too."""
    return lanes - lane if name == "merge" else lanes - 1 - lane


def plain_network(roads: Sequence[Road]) -> dict[str, str]:
    """netconvert's plain XML of one motorway a row, by option of netconvert."""
    lanes = [road.lanes for road in roads]
    return {
        "--node-files": "\n".join(("<nodes>", *_nodes(lanes), "</nodes>")),
        "--edge-files": "\n".join(("<edges>", *_edges(lanes), "</edges>")),
        "--connection-files": "\n".join(("<connections>", *_connections(lanes), "</connections>")),
    }


def routes(row: int) -> list[list[str]]:
    """The edges of each route, in order: `ON_MOTORWAY` and `ON_RAMP`."""
    through = [edge(name, row) for name in THROUGH]
    return [through, [edge(RAMP, row), *through[1:]]]


def stretches(row: int, route: int, lane: int, lanes: int) -> list[str]:
    """SUMO's lanes on which a car of a route may start in lane `lane` (from the left), one behind the other."""
    if route == ON_RAMP:
        return [f"{edge(RAMP, row)}_0"]
    return [f"{edge(name, row)}_{lane_number(name, lane, lanes)}" for name in THROUGH]


def _ends(row: int) -> tuple[str, ...]:
    return tuple(f"{name}_{row}" for name in ("start", "join", "drop", "end"))


def _ramp_y(lanes: int) -> float:
    """SUMO's y of the centre of the ramp's lane."""
    return -LANE_WIDTH * (lanes + 0.5)


def _nodes(lanes: Sequence[int]) -> Iterator[str]:
    places = (0.0, MERGE, MERGE + MERGE_LENGTH, LENGTH)
    for row, count in enumerate(lanes):
        for name, x in zip(_ends(row), places, strict=True):
            yield f'<node id="{name}" x="{x:g}" y="0" type="priority"/>'
        yield f'<node id="ramp_{row}" x="{MERGE - RAMP_LENGTH:g}" y="{_ramp_y(count) - RAMP_ASIDE:g}"/>'


def _edges(lanes: Sequence[int]) -> Iterator[str]:
    common = f'width="{LANE_WIDTH:g}" speed="{SPEED_LIMIT:g}"'
    for row, count in enumerate(lanes):
        ends = _ends(row)
        for place, name in enumerate(THROUGH):
            yield (
                f'<edge id="{edge(name, row)}" from="{ends[place]}" to="{ends[place + 1]}" '
                f'numLanes="{count + (name == "merge")}" priority="3" {common}/>'
            )
        y = _ramp_y(count) + LANE_WIDTH / 2
        points = ((RAMP_LENGTH, y - RAMP_ASIDE), (RAMP_STRAIGHT, y), (0.0, y))
        shape = " ".join(f"{MERGE - before:g},{across:g}" for before, across in points)
        yield (
            f'<edge id="{edge(RAMP, row)}" from="ramp_{row}" to="{ends[1]}" '
            f'numLanes="1" priority="1" shape="{shape}" {common}/>'
        )


def _connections(lanes: Sequence[int]) -> Iterator[str]:
    for row, count in enumerate(lanes):
        stretches = [edge(name, row) for name in THROUGH]
        for lane in range(count):
            for place in (0, 1):
                numbers = [lane_number(THROUGH[place + step], lane, count) for step in (0, 1)]
                yield (
                    f'<connection from="{stretches[place]}" to="{stretches[place + 1]}" '
                    f'fromLane="{numbers[0]}" toLane="{numbers[1]}"/>'
                )
        yield f'<connection from="{edge(RAMP, row)}" to="{stretches[1]}" fromLane="0" toLane="0"/>'
