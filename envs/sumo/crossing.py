"""An urban crossing, for netconvert: one for each episode of a batch, all in the same place.

The ego comes from the west and goes straight on; x grows to the east. As on the motorway, SUMO's y grows to the left of the ego,
and 0 is the left edge of its lanes; so the cars that come towards it drive at y > 0 in SUMO, and at y < 0 in cavbench. The road
across has a lane each way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from cavbench.envs.highway.dynamics import LANE_WIDTH
from cavbench.envs.sumo.roads import Road, edge

LENGTH = 900.0
"""Of each of the four roads, in m from the middle of the crossing: farther than a car drives in an episode, at 40 m/s."""
MIDDLE = 120.0
"""x of the crossing, so that the ego, which starts before it, is at x > 0: there highway's lanes begin."""
SPEED_LIMIT = 13.89
"""m/s: 50 km/h."""
SIDES = {"west": (-1, 0), "east": (1, 0), "south": (0, -1), "north": (0, 1)}
"""Where the roads lead, in SUMO's directions."""
ROUTES = (
    ("west", "east"),
    ("west", "south"),
    ("west", "north"),
    ("east", "west"),
    ("east", "south"),
    ("south", "north"),
    ("south", "east"),
    ("north", "south"),
    ("north", "east"),
)
"""From where to where cars drive: straight on, and those turns that the ego meets."""
RULES = {"yield": "priority", "allway_stop": "allway_stop"}
"""Who goes first, with SUMO's type of junction. `right_before_left` draws random numbers, which all crossings share."""


def arm(side: str, row: int, *, towards: bool) -> str:
    """The name of a road towards the crossing, or away from it."""
    return edge(f"{'from' if towards else 'to'}_{side}", row)


def plain_network(roads: Sequence[Road]) -> dict[str, str]:
    """netconvert's plain XML of one crossing a row, by option of netconvert."""
    return {
        "--node-files": "\n".join(("<nodes>", *_nodes(roads), "</nodes>")),
        "--edge-files": "\n".join(("<edges>", *_edges(roads), "</edges>")),
        "--connection-files": "\n".join(("<connections>", *_connections(roads), "</connections>")),
    }


def routes(row: int) -> list[list[str]]:
    """The edges of each route, in order."""
    return [[arm(start, row, towards=True), arm(end, row, towards=False)] for start, end in ROUTES]


def stretches(row: int, route: int, lane: int, lanes: int) -> list[str]:
    """SUMO's lanes on which a car may start: the lane (from the left) of its road towards the crossing."""
    return [f"{arm(ROUTES[route][0], row, towards=True)}_{lanes - 1 - lane}"]


def _lanes(side: str, road: Road) -> int:
    return road.lanes if side in ("west", "east") else 1


def _nodes(roads: Sequence[Road]) -> Iterator[str]:
    for row, road in enumerate(roads):
        yield f'<node id="{edge("crossing", row)}" x="{MIDDLE:g}" y="0" type="{RULES[road.rule]}"/>'
        for side, (x, y) in SIDES.items():
            yield f'<node id="{edge(side, row)}" x="{MIDDLE + x * LENGTH:g}" y="{y * LENGTH:g}"/>'


def _edges(roads: Sequence[Road]) -> Iterator[str]:
    for row, road in enumerate(roads):
        for side in SIDES:
            # Only with `yield` has one road priority: the one across.
            first = road.rule == "yield" and side in ("south", "north")
            common = (
                f'numLanes="{_lanes(side, road)}" priority="{2 if first else 1}" width="{LANE_WIDTH:g}" '
                f'speed="{SPEED_LIMIT:g}"'
            )
            ends = edge(side, row), edge("crossing", row)
            yield f'<edge id="{arm(side, row, towards=True)}" from="{ends[0]}" to="{ends[1]}" {common}/>'
            yield f'<edge id="{arm(side, row, towards=False)}" from="{ends[1]}" to="{ends[0]}" {common}/>'


def _connections(roads: Sequence[Road]) -> Iterator[str]:
    for row, road in enumerate(roads):
        for start, end in ROUTES:
            ways = arm(start, row, towards=True), arm(end, row, towards=False)
            straight = {start, end} in ({"west", "east"}, {"south", "north"})
            for lane in range(min(_lanes(start, road), _lanes(end, road)) if straight else 1):
                # SUMO counts from the right. Who turns left does it from the lane on the left.
                left = not straight and (start, end) in (("west", "north"), ("east", "south"))
                own = _lanes(start, road) - 1 if left else lane
                yield f'<connection from="{ways[0]}" to="{ways[1]}" fromLane="{own}" toLane="{lane}"/>'
