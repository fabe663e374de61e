"""Networks of lanes: highway-env's road/lane.py and the graph of road/road.py, laid out as a record for compiled code.

A network is built in Python, lane by lane, in highway-env's order: the order decides ties between lanes. `record` lays it out, so
that each episode of a batch may be on another one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.highway.state import record_type

Point = Sequence[float] | NDArray[np.float64]

WIDTH = 4.0
"""AbstractLane.DEFAULT_WIDTH in m."""
MARGIN = 1.0
"""Road.neighbour_vehicles: up to so many m beside a lane, cars are neighbours on it."""
CAR_LENGTH = 5.0
"""AbstractLane.VEHICLE_LENGTH in m."""
SURELY = 1e-6
"""Margin in m, larger than any rounding error."""
NEAR = 1.5
"""While a body's distance from its lane in m plus its angle in rad is at most this, only lanes in `ROAD.near` may be closer."""


class LaneKind(IntEnum):
    """The shapes of highway-env's lanes."""

    STRAIGHT = 0
    SINE = 1
    CIRCULAR = 2


class Line(IntEnum):
    """highway-env's LineType: how a side of a lane is painted."""

    NONE = 0
    STRIPED = 1
    CONTINUOUS = 2
    CONTINUOUS_LINE = 3


@dataclass(kw_only=True)
class Lane:
    """A lane; `straight`, `sine` and `circular` make one.

    A straight lane runs from `start` along `direction` (a unit vector) at `heading`. A sine lane swings around it by `amplitude`
    sin(`pulsation` s + `phase`). A circular one turns around `center` from `start_phase`, to the right if `turn` is 1, to the
    left if it is -1 (y points to the right). Cars up to `margin` beside it are neighbours on it. Lengths in m, angles in rad,
    `speed_limit` in m/s.
    """

    kind: LaneKind
    length: float
    width: float = WIDTH
    margin: float = MARGIN
    start: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    direction: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    heading: float = 0.0
    amplitude: float = 0.0
    pulsation: float = 0.0
    phase: float = 0.0
    center: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    radius: float = 0.0
    start_phase: float = 0.0
    turn: float = 0.0
    forbidden: bool = False
    speed_limit: float = 20.0
    priority: int = 0
    lines: tuple[int, int] = (Line.STRIPED, Line.STRIPED)

    def position(self, along: float, across: float) -> NDArray[np.float64]:
        """The point [2] at `along` m on the lane and `across` m to its right."""
        if self.kind == LaneKind.CIRCULAR:
            angle = self.turn * along / self.radius + self.start_phase
            return self.center + (self.radius - across * self.turn) * np.array([np.cos(angle), np.sin(angle)])
        if self.kind == LaneKind.SINE:
            across = across + self.amplitude * np.sin(self.pulsation * along + self.phase)
        return self.start + along * self.direction + across * np.array([-self.direction[1], self.direction[0]])


def straight(start: Point, end: Point, **options: object) -> Lane:
    """highway-env's StraightLane from `start` to `end`; `options` are the other fields of `Lane`."""
    first, last = np.array(start, dtype=np.float64), np.array(end, dtype=np.float64)
    length = float(np.linalg.norm(last - first))
    heading = float(np.arctan2(last[1] - first[1], last[0] - first[0]))
    line = {"start": first, "direction": (last - first) / length, "heading": heading, "length": length}
    return Lane(kind=LaneKind.STRAIGHT, **line, **options)  # type: ignore[arg-type]


def sine(start: Point, end: Point, amplitude: float, pulsation: float, phase: float, **options: object) -> Lane:
    """highway-env's SineLane around the line from `start` to `end`."""
    lane = straight(start, end, **options)
    lane.kind, lane.amplitude, lane.pulsation, lane.phase = LaneKind.SINE, amplitude, pulsation, phase
    return lane


def circular(
    center: Point, radius: float, start_phase: float, end_phase: float, *, clockwise: bool = True, **options: object
) -> Lane:
    """highway-env's CircularLane."""
    turn = 1.0 if clockwise else -1.0
    length = radius * (end_phase - start_phase) * turn
    arc = {"center": np.array(center, dtype=np.float64), "radius": radius, "start_phase": start_phase, "turn": turn}
    return Lane(kind=LaneKind.CIRCULAR, length=length, **arc, **options)  # type: ignore[arg-type]


class LaneRecord:
    """One lane in compiled code; see `Lane`."""

    kind: int
    forbidden: bool
    edge: int  # the road that it belongs to
    number: int  # its number on that road, 0 the leftmost
    priority: int
    length: float
    width: float
    margin: float  # m beside it, up to which bodies are neighbours on it
    speed_limit: float  # m/s
    start_x: float
    start_y: float
    direction_x: float
    direction_y: float
    heading: float
    amplitude: float
    pulsation: float
    phase: float
    center_x: float
    center_y: float
    radius: float
    start_phase: float
    turn: float
    inside: float  # m2, square of the least distance from the centre of bodies on a circular lane or within its margin
    outside: float  # m2, square of the largest one
    middle_x: float  # direction from the centre to the middle of the arc
    middle_y: float
    least_x: float  # m along that direction, the least of the same bodies
    alone_from: float  # m along it; to `alone_to` no other lane can be closer to a body within `NEAR` of it
    alone_to: float  # m
    linked: int  # how many lanes are searched for its neighbours, itself included


class EdgeRecord:
    """One road in compiled code: the lanes from one node to another."""

    first: int  # number of its first lane
    lanes: int
    start: int  # node
    end: int  # node


LANE = record_type(LaneRecord)
EDGE = record_type(EdgeRecord)

MOST_LANES, MOST_EDGES, MOST_LINKED, MOST_SPOTS = 64, 48, 8, 8
MOST_ROUTES, LONGEST_ROUTE, DEPTH = 256, 16, 3
"""Sizes of the tables. They are fixed, so that one compiled engine serves all networks."""

ROAD = np.dtype(
    [
        ("lane_count", np.int64),
        ("edge_count", np.int64),
        ("end", np.float64),  # m along x, where the task is done
        ("factor", np.float64),  # by which the spacing of cars is reduced
        ("spots", np.int64, (MOST_SPOTS,)),  # lanes that the task names
        ("lanes", LANE, (MOST_LANES,)),
        ("edges", EDGE, (MOST_EDGES,)),  # roads, in highway-env's order
        ("near", np.int8, (MOST_LANES, MOST_LANES)),  # for each lane the others that may be closer, -1 after the last
        ("linked", np.int64, (MOST_LANES, MOST_LINKED)),  # lanes that are searched for neighbours
        ("offsets", np.float64, (MOST_LANES, MOST_LINKED)),  # m, where they begin on the lane
        ("routes", np.int16, (MOST_ROUTES, LONGEST_ROUTE)),  # roads from a lane to a destination, -1 after the end
        ("route_lanes", np.int16, (MOST_ROUTES, LONGEST_ROUTE)),  # the lane on each of them, -1 for any
        (
            "reach",
            np.int8,
            (DEPTH + 1, MOST_EDGES, MOST_EDGES),
        ),  # whether one road leads to another within so many roads
        ("way_after", np.float64, (MOST_LANES,)),  # m from the end of a lane to the goal
        ("way_length", np.float64, (MOST_LANES,)),  # m of the way on a lane, 0 if it is not on the way
        ("astray", np.int8, (MOST_LANES,)),  # whether the goal cannot be reached any more from a lane
    ],
    align=True,
)
"""A network in compiled code. One record is one argument of a function, where a tuple of arrays would be fifty."""


@dataclass
class Network:
    """A graph of roads: `graph[from][to]` is the list of lanes from one node to another, from left to right.

    Args:
        connected: whether cars look for neighbours on the lanes before and after their own, too: the tasks with v1 (v2 for
            the intersection) of highway-env 1.12.
    """

    connected: bool = False
    graph: dict[str, dict[str, list[Lane]]] = field(default_factory=dict)

    def add(self, start: str, end: str, lane: Lane) -> None:
        """RoadNetwork.add_lane."""
        self.graph.setdefault(start, {}).setdefault(end, []).append(lane)

    def add_straight(self, start: str, end: str, lanes: int, origin: float, length: float, speed_limit: float) -> None:
        """RoadNetwork.straight_road_network: parallel lanes along x from `origin` m."""
        for lane in range(lanes):
            sides = (
                Line.CONTINUOUS_LINE if lane == 0 else Line.STRIPED,
                Line.CONTINUOUS_LINE if lane == lanes - 1 else Line.NONE,
            )
            y = lane * WIDTH
            self.add(start, end, straight([origin, y], [origin + length, y], lines=sides, speed_limit=speed_limit))

    def roads(self) -> Iterator[tuple[str, str, list[Lane]]]:
        """Every road with its nodes, in highway-env's order."""
        for start, ends in self.graph.items():
            for end, lanes in ends.items():
                yield start, end, lanes

    def lanes(self) -> list[Lane]:
        """Every lane, by its number."""
        return [lane for _, _, lanes in self.roads() for lane in lanes]

    def number(self, start: str, end: str, lane: int) -> int:
        """The number of a lane of the road from `start` to `end`."""
        before = 0
        for first, last, lanes in self.roads():
            if (first, last) == (start, end):
                return before + lane
            before += len(lanes)
        raise KeyError(f"no road from {start} to {end}")

    def linked(self, start: str, end: str, lane: int) -> list[tuple[int, float]]:
        """Road.neighbour_vehicles: the lanes that are searched for a car's neighbours, and where they begin, in m."""
        own = self.graph[start][end][lane]
        found = [(self.number(start, end, lane), 0.0)]
        if self.connected:
            for after, lanes in self.graph.get(end, {}).items():
                found.append((self.number(end, after, lane if lane < len(lanes) else 0), own.length))
            for before, ends in self.graph.items():
                if start in ends:
                    place = lane if lane < len(ends[start]) else 0
                    found.append((self.number(before, start, place), -ends[start][place].length))
        return found

    def path(self, start: str, goal: str) -> list[str]:
        """RoadNetwork.shortest_path: the nodes from `start` to `goal`, breadth first; empty if there is no way."""
        queue = [[start]]
        while queue:
            path = queue.pop(0)
            for after in sorted(node for node in self.graph.get(path[-1], {}) if node not in path):
                if after == goal:
                    return [*path, after]
                if after in self.graph:
                    queue.append([*path, after])
        return []

    def route(self, start: str, end: str, lane: int, goal: str) -> list[tuple[int, int]]:
        """ControlledVehicle.plan_route_to: the roads from a lane to a node, and the lane on each, -1 for any."""
        edges = {(first, last): number for number, (first, last, _) in enumerate(self.roads())}
        path = self.path(end, goal)
        return [(edges[start, end], lane), *((edges[pair], -1) for pair in pairwise(path))]


def _fill(place: np.void, lane: Lane) -> None:
    for name in ("kind", "forbidden", "priority", "length", "width", "margin", "speed_limit", "heading", "amplitude"):
        place[name] = getattr(lane, name)
    for name in ("pulsation", "phase", "radius", "start_phase", "turn"):
        place[name] = getattr(lane, name)
    place["start_x"], place["start_y"] = lane.start
    place["direction_x"], place["direction_y"] = lane.direction
    place["center_x"], place["center_y"] = lane.center
    if lane.kind == LaneKind.CIRCULAR:
        _fill_bounds(place, lane)


def _fill_bounds(place: np.void, lane: Lane) -> None:
    """Where bodies on a circular lane or within its margin may be; 1 um more than any rounding error."""
    reach = lane.width / 2 + lane.margin + SURELY
    nearest, farthest = max(lane.radius - reach, 0.0), lane.radius + reach
    middle = lane.start_phase + lane.turn * lane.length / 2 / lane.radius
    angle = (lane.length / 2 + CAR_LENGTH) / lane.radius
    share = np.cos(max(angle, 0.0)) if angle < np.pi else -1.0
    place["inside"], place["outside"] = nearest**2, farthest**2
    place["middle_x"], place["middle_y"] = np.cos(middle), np.sin(middle)
    place["least_x"] = min(nearest * share, farthest * share) - SURELY


@dataclass(frozen=True, kw_only=True)
class Way:
    """The way to a goal.

    Args:
        roads: the roads of the way as pairs of nodes; the goal is on the last one.
        goal: where the goal is on that road, in m from its beginning.
        astray: roads from which the goal cannot be reached any more.
        sideways: metres that a lane to the right counts, where the goal is on the right.
    """

    roads: tuple[tuple[str, str], ...]
    goal: float
    astray: tuple[tuple[str, str], ...] = ()
    sideways: float = 0.0

    def write(self, network: Network, road: np.void) -> None:
        """Write the way into a record `ROAD`. All lanes of a road count as long as its first one."""
        left, most = 0.0, max(len(network.graph[start][end]) for start, end in self.roads)
        for start, end in reversed(self.roads):
            lanes = network.graph[start][end]
            length = lanes[0].length if (start, end) != self.roads[-1] else self.goal
            first = network.number(start, end, 0)
            road["way_length"][first : first + len(lanes)] = length
            beside = most - 1 - np.arange(len(lanes)) if (start, end) != self.roads[-1] else np.zeros(1)
            road["way_after"][first : first + len(lanes)] = left + self.sideways * beside
            left += length
        for start, end in self.astray:
            first = network.number(start, end, 0)
            road["astray"][first : first + len(network.graph[start][end])] = 1


def record(
    network: Network,
    *,
    spots: Sequence[int] = (),
    destinations: Sequence[str] = (),
    end: float = np.inf,
    factor: float = 1.0,
    way: Way | None = None,
) -> NDArray[np.void]:
    """A network as an array of one record `ROAD`.

    Args:
        network: the network.
        spots: numbers of the lanes that the task names.
        destinations: nodes to which routes are planned; the route from lane l to destination d is row l * D + d.
        end: place in m along x at which the task is done.
        factor: by which the spacing of cars is reduced at the start.
        way: the way to the ego's goal, for worlds whose progress it is.

    Raises:
        ValueError: if the network is larger than the tables.
    """
    roads = list(network.roads())
    nodes = {name: number for number, name in enumerate(dict.fromkeys(n for s, e, _ in roads for n in (s, e)))}
    lanes = sum(len(members) for _, _, members in roads)
    if lanes > MOST_LANES or len(roads) > MOST_EDGES or lanes * len(destinations) > MOST_ROUTES:
        raise ValueError(f"a network has at most {MOST_LANES} lanes and {MOST_EDGES} roads, got {lanes}, {len(roads)}")
    table = np.zeros(1, dtype=ROAD)
    road = table[0]
    road["lane_count"], road["edge_count"], road["end"] = lanes, len(roads), end
    road["factor"], road["reach"] = factor, _reach(roads)
    road["near"], alone = _near(network.lanes())
    road["spots"][: len(spots)] = spots
    road["routes"] = road["route_lanes"] = -1
    if way is not None:
        way.write(network, road)
    number = 0
    for edge, (start, last, members) in enumerate(roads):
        road["edges"][edge] = (number, len(members), nodes[start], nodes[last])
        for own, lane in enumerate(members):
            place = road["lanes"][number]
            _fill(place, lane)
            linked = network.linked(start, last, own)
            place["edge"], place["number"], place["linked"] = edge, own, len(linked)
            place["alone_from"], place["alone_to"] = alone[number]
            for link, (other, offset) in enumerate(linked):
                road["linked"][number, link], road["offsets"][number, link] = other, offset
            for goal, name in enumerate(destinations):
                route = network.route(start, last, own, name)
                row = number * len(destinations) + goal
                road["routes"][row, : len(route)] = [towards for towards, _ in route]
                road["route_lanes"][row, : len(route)] = [wanted for _, wanted in route]
            number += 1
    return table


def _near(lanes: Sequence[Lane], spacing: float = 0.5) -> tuple[NDArray[np.int8], list[tuple[float, float]]]:
    """[MOST_LANES, MOST_LANES] for each lane the numbers of those that may be closer to a body within `NEAR` of it, then -1.

    A lane is left out if it is surely farther than `NEAR` from every such place. Points `spacing` m apart are checked.
    The list has the longest stretch of each lane, in m, on which all others are left out; from inf to -inf if there is none.
    """
    table = np.full((MOST_LANES, MOST_LANES), -1, dtype=np.int8)
    stretches = []
    for number, lane in enumerate(lanes):
        along = np.linspace(0.0, lane.length, 2 + int(lane.length / spacing))
        points = _points(lane, along)
        reach = NEAR + abs(lane.amplitude) + spacing / 2 + NEAR
        close = np.array([_distance(other, points) - abs(other.amplitude) <= reach for other in lanes])
        close[number] = False
        found = np.flatnonzero(close.any(1))
        table[number, : len(found)] = found
        stretches.append(_longest(along, np.logical_not(close.any(0))))
    return table, stretches


def _longest(along: NDArray[np.float64], free: NDArray[np.bool_]) -> tuple[float, float]:
    """The first and last m of the longest run of points that are `free`; inf and -inf without one."""
    ends = np.flatnonzero(np.diff(free, prepend=False, append=False))
    if not len(ends):
        return np.inf, -np.inf
    longest = np.argmax(ends[1::2] - ends[::2])
    return float(along[ends[2 * longest]]), float(along[ends[2 * longest + 1] - 1])


def _points(lane: Lane, along: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N, 2] points on a lane; on a sine lane those on the line that it swings around."""
    if lane.kind == LaneKind.CIRCULAR:
        angle = lane.turn * along / lane.radius + lane.start_phase
        return lane.center + lane.radius * np.stack([np.cos(angle), np.sin(angle)], 1)
    return lane.start + along[:, None] * lane.direction


def _distance(lane: Lane, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N] Euclidean distances in m of points [N, 2] from a lane, of a sine lane those from the line that it swings around.

    highway-env's distance from a lane adds what is beside it and what is beyond its end, so it is never smaller.
    """
    if lane.kind == LaneKind.CIRCULAR:
        x, y = (points - lane.center).T
        along = lane.turn * (np.arctan2(y, x) - lane.start_phase) % (2 * np.pi) * lane.radius
        ends = _points(lane, np.array([0.0, lane.length]))
        to_ends = np.linalg.norm(points[:, None] - ends, axis=2).min(1)
        return np.where(along <= lane.length, abs(np.hypot(x, y) - lane.radius), to_ends)
    x, y = (points - lane.start).T
    along, across = x * lane.direction[0] + y * lane.direction[1], y * lane.direction[0] - x * lane.direction[1]
    return np.hypot(across, np.maximum(np.maximum(-along, along - lane.length), 0.0))


def _reach(roads: Sequence[tuple[str, str, list[Lane]]]) -> NDArray[np.int8]:
    """[DEPTH + 1, E, E] RoadNetwork.is_connected_road without a route: whether a road is, or comes after, another one."""
    table = np.zeros((DEPTH + 1, MOST_EDGES, MOST_EDGES), dtype=np.int8)
    for edge, (start, _, _) in enumerate(roads):
        for goal, (_, end, _) in enumerate(roads):
            table[:, edge, goal] = int(edge == goal or end == start)
    for depth in range(1, DEPTH + 1):
        for edge, (_, end, _) in enumerate(roads):
            after = [number for number, (start, _, _) in enumerate(roads) if start == end]
            table[depth, edge] |= table[depth - 1, after].max(0, initial=0)
    return table
