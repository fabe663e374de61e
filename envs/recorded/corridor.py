"""The road of a scene, straightened: parallel lanes along x, and every road user in their coordinates.

Places are measured along and across a reference line, the smoothed centre of a lane beside the start of the planning problem. In
a bend of radius R, a length at y m from the line is off by a share of y / R. So a road that bends too much is refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cavbench.envs.recorded.scene import Floats, Lanelet, Recording

STEP_M = 1.0
SMOOTHED_M, BEYOND_M = 40.0, 120.0
"""The reference line is smoothed over so many m, and goes on straight for so many m at both ends."""
LEAST_RADIUS_M = 150.0
LEAST_LENGTH_M, MOST_LENGTH_M = 80.0, 5_000.0
STRAIGHT_ON = math.pi / 6
"""A piece of a lane that turns by more leaves the road."""
COVERED = 0.97
"""A lane is one of the road if it has so much of its length."""
UNEVEN_M = 0.6
"""Lanes count as evenly spaced up to this distance of a centre from its place."""
WIDTHS = (2.0, 6.0)
MOST_PRODUCTS = 4_000_000
"""Distances that are computed at a time; it limits the memory."""
MOST_LANES = 12


@dataclass(frozen=True, kw_only=True, eq=False)
class Corridor:
    """Straight parallel lanes, and the way into their coordinates: x along them in m from where they begin, y to the right.

    Lane i has its centre at y = i * `lane_width`.

    Args:
        lanes: how many there are.
        lane_width: in m.
        length: in m.
        line: [N, 2] points of the reference line, `STEP_M` apart; the first is `BEYOND_M` before the lanes.
        across: y of the reference line in m.
        radius: the smallest radius of the line in m.
        uneven: the largest distance in m of a real centre of a lane, averaged over 5 m, from its place.
    """

    lanes: int
    lane_width: float
    length: float
    line: Floats
    across: float
    radius: float
    uneven: float

    def coordinates(self, places: Floats) -> Floats:
        """x, y and heading [N, 3] of places and headings [N, 3] in the coordinates of the scene. y and heading turn right."""
        along, across, turned = _projected(self.line, places)
        return np.stack([along - BEYOND_M, self.across - across, -turned], 1)


def corridor(recording: Recording) -> Corridor:
    """The road on which the first planning problem starts, or without one, most road users.

    Each lane beside the start is tried as the reference line. The one along which most metres of lanes run counts, so that no
    exit and no lane that ends decides.

    Raises:
        ValueError: in one line, if the scene has no such road.
    """
    found, refused = [], []
    for lanelet in _abreast(recording, _start(recording)):
        try:
            found.append(_along(recording, _chain(recording, lanelet)))
        except ValueError as error:
            refused.append(error)
    if not found:
        raise refused[0]
    return max(found, key=lambda road: (road.lanes * road.length, -road.uneven))


def _along(recording: Recording, chain: list[Lanelet]) -> Corridor:
    """The road along the lanelets of a lane."""
    line = _line(np.concatenate([lanelet.centre for lanelet in chain]))
    length = (len(line) - 1) * STEP_M - 2 * BEYOND_M
    if length < LEAST_LENGTH_M:
        raise ValueError(f"its road goes straight on for {length:.0f} m, at least {LEAST_LENGTH_M:.0f} m are needed")
    if (radius := _radius(line)) < LEAST_RADIUS_M:
        raise ValueError(f"its road bends with a radius of {radius:.0f} m, at least {LEAST_RADIUS_M:.0f} m are needed")
    lanes = _lanes(recording, chain, line, length)
    centres = np.array([np.median(places) for places, _ in lanes])
    width = float(np.diff(centres).mean()) if len(lanes) > 1 else float(lanes[0][1])
    first = float((centres - width * np.arange(len(lanes))).mean())
    if not WIDTHS[0] <= width <= WIDTHS[1]:
        raise ValueError(f"its lanes are {width:.1f} m wide, allowed are {WIDTHS[0]:g} to {WIDTHS[1]:g} m")
    uneven = max(float(np.abs(places - first - width * place).max()) for place, (places, _) in enumerate(lanes))
    if uneven > UNEVEN_M:
        raise ValueError(f"its lanes are not parallel: a centre is {uneven:.1f} m from where equal widths put it")
    return Corridor(
        lanes=len(lanes), lane_width=width, length=length, line=line, across=-first, radius=radius, uneven=uneven
    )


def _abreast(recording: Recording, start: Lanelet) -> list[Lanelet]:
    """A lanelet, and those beside it that lead in the same direction."""
    found = [start]
    for side in (0, 1):
        other = _neighbour(recording, start, side)
        while other is not None and other not in found and len(found) < MOST_LANES:
            found.append(other)
            other = _neighbour(recording, other, side)
    return found


def _neighbour(recording: Recording, lanelet: Lanelet, side: int) -> Lanelet | None:
    """The lanelet at the left (0) or right (1) side of another one, if the file has it."""
    number = lanelet.beside[side]
    return None if number is None else recording.lanelets.get(number)


def _start(recording: Recording) -> Lanelet:
    """The lanelet on which the ego starts."""
    if recording.problems:
        problem = recording.problems[0]
        places = np.array([[problem.x, problem.y, problem.heading]])
    else:
        places = np.array([track.states[0, :3] for track in recording.tracks if track.moves]).reshape(-1, 3)
    if not len(places):
        raise ValueError("it has neither a planning problem nor a road user that moves, so no road is chosen")
    hits = {number: _on(lanelet, places) for number, lanelet in recording.lanelets.items()}
    best = max(hits, key=lambda number: hits[number])
    if not hits[best]:
        raise ValueError(
            "its planning problem starts beside its lanes"
            if recording.problems
            else "its road users are beside its lanes"
        )
    return recording.lanelets[best]


def _on(lanelet: Lanelet, places: Floats) -> float:
    """How many places [N, 3] are on a lanelet and head along it; one half for a place on its border."""
    polygon = np.concatenate([lanelet.left, lanelet.right[::-1]])
    x, y = places[:, :1], places[:, 1:2]
    x1, y1 = polygon.T
    x2, y2 = np.roll(polygon, -1, 0).T
    crosses = (y1 > y) != (y2 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = x < (x2 - x1) * (y - y1) / (y2 - y1) + x1
    inside = (crosses & left).sum(1) % 2 == 1
    centre = lanelet.centre
    nearest = np.hypot(x - centre[:-1, 0], y - centre[:-1, 1]).argmin(1)
    step = np.diff(centre, axis=0)[nearest]
    along = np.abs(_wrapped(np.arctan2(step[:, 1], step[:, 0]) - places[:, 2])) < math.pi / 4
    return float((inside & along).sum())


def _wrapped(angle: Floats) -> Floats:
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _headings(lanelet: Lanelet) -> tuple[float, float]:
    """Headings in rad over the first and over the last third of a lanelet."""
    centre, third = lanelet.centre, max(1, len(lanelet.left) // 3)
    begin, end = centre[third] - centre[0], centre[-1] - centre[-1 - third]
    return math.atan2(begin[1], begin[0]), math.atan2(end[1], end[0])


def _chain(recording: Recording, start: Lanelet) -> list[Lanelet]:
    """The lanelets that lead straight on, from the first one to the last."""
    chain = [start]
    for forward in (True, False):
        while True:
            end = chain[-1] if forward else chain[0]
            heading = _headings(end)[1 if forward else 0]
            best, least = None, STRAIGHT_ON
            for number in end.after if forward else end.before:
                other = recording.lanelets.get(number)
                if other is None or other in chain:
                    continue
                turn = max(abs(float(_wrapped(np.array(one - heading)))) for one in _headings(other))
                if turn < least:
                    best, least = other, turn
            if best is None:
                break
            chain.insert(len(chain) if forward else 0, best)
    return chain


def _line(points: Floats) -> Floats:
    """The reference line [N, 2] of a polyline: `STEP_M` apart, prolonged and smoothed."""
    points = points[np.append(True, np.hypot(*np.diff(points, axis=0).T) > 0.05)]
    if len(points) < 2:
        raise ValueError("its road has no length")
    ends = []
    for end in (points, points[::-1]):
        far = end[np.hypot(*(end - end[0]).T) >= 20.0]
        outwards = end[0] - (far[0] if len(far) else end[-1])
        if not np.hypot(*outwards) > 0:
            raise ValueError("its road ends where it begins")
        ends.append(end[0] + outwards / np.hypot(*outwards) * (BEYOND_M + SMOOTHED_M))
    whole = np.concatenate([ends[:1], points, ends[1:]])
    place = np.append(0.0, np.hypot(*np.diff(whole, axis=0).T).cumsum())
    if place[-1] > MOST_LENGTH_M:
        raise ValueError(
            f"its road goes on for {place[-1] / 1000:.1f} km, at most {MOST_LENGTH_M / 1000:g} km are driven"
        )
    count = round(place[-1] / STEP_M)
    at = np.linspace(0, place[-1], count + 1)
    dense = np.stack([np.interp(at, place, column) for column in whole.T], 1)
    window = np.hanning(round(SMOOTHED_M / STEP_M) + 1)
    smooth = np.stack([np.convolve(column, window / window.sum(), "valid") for column in dense.T], 1)
    # Smoothing cuts half of the window at both ends; the rest of what was added is cut here.
    extra = round((SMOOTHED_M - SMOOTHED_M / 2) / STEP_M)
    smooth = smooth[extra : len(smooth) - extra]
    place = np.append(0.0, np.hypot(*np.diff(smooth, axis=0).T).cumsum())
    at = np.arange(0.0, place[-1], STEP_M)
    return np.stack([np.interp(at, place, column) for column in smooth.T], 1)


def _directions(line: Floats) -> Floats:
    """Heading in rad at each point of a line."""
    step = np.gradient(line, axis=0)
    return np.unwrap(np.arctan2(step[:, 1], step[:, 0]))


def _radius(line: Floats) -> float:
    """The smallest radius in m, over 20 m."""
    turned, reach = _directions(line), round(20.0 / STEP_M)
    return reach * STEP_M / max(float(np.abs(turned[reach:] - turned[:-reach]).max()), 1e-9)


def _projected(line: Floats, places: Floats) -> tuple[Floats, Floats, Floats]:
    """Metres along a line and to its left, and the heading relative to it, of places and headings [N, 3]."""
    directions, numbers = _directions(line), np.arange(len(line), dtype=np.float64)
    middle = line.mean(0)
    off, points = places[:, :2] - middle, line - middle
    parts = len(off) * len(line) // MOST_PRODUCTS + 1
    # The nearest point of the line has the smallest |c|^2 - 2 p c; that is one product of matrices.
    near = [((points**2).sum(1) - 2 * part @ points.T).argmin(1) for part in np.array_split(off, parts)]
    along = np.concatenate(near).astype(np.float64)
    for _ in range(3):
        x, y, turned = (np.interp(along, numbers, column) for column in (*line.T, directions))
        ahead = (places[:, 0] - x) * np.cos(turned) + (places[:, 1] - y) * np.sin(turned)
        # The line goes on straight beyond its ends.
        along = np.clip(along + ahead / STEP_M, 0, len(line) - 1)
    x, y, turned = (np.interp(along, numbers, column) for column in (*line.T, directions))
    off_x, off_y = places[:, 0] - x, places[:, 1] - y
    beyond = off_x * np.cos(turned) + off_y * np.sin(turned)
    across = off_y * np.cos(turned) - off_x * np.sin(turned)
    return along * STEP_M + beyond, across, _wrapped(places[:, 2] - turned)


def _lanes(recording: Recording, chain: list[Lanelet], line: Floats, length: float) -> list[tuple[Floats, float]]:
    """Of each lane that runs along the whole road, from left to right: y of its centre every 5 m, and its width."""
    stations = np.arange(2.5, length, 5.0)
    lanes = {}
    for side, step in ((1, 1), (0, -1)):
        place, members = 0, chain
        while members and abs(place) < MOST_LANES:
            middle, width = np.full(len(stations), np.nan), np.full(len(stations), np.nan)
            for lanelet in members:
                _fill(lanelet, line, stations, middle, width)
            there = np.isfinite(middle)
            if there.mean() < COVERED:
                break
            lanes[place] = (middle[there], float(np.median(width[there])))
            beside = [_neighbour(recording, lanelet, side) for lanelet in members]
            members, place = [lanelet for lanelet in beside if lanelet is not None], place + step
    if not lanes:
        raise ValueError("its lanes have gaps")
    return [lanes[place] for place in sorted(lanes)]


def _fill(lanelet: Lanelet, line: Floats, stations: Floats, middle: Floats, width: Floats) -> None:
    """Write y of the centre, and the width, of a lanelet at those stations that it covers."""
    sides = []
    for border in (lanelet.left, lanelet.right):
        along, across, _ = _projected(line, np.column_stack([border, np.zeros(len(border))]))
        order = np.argsort(along)
        along, across = along[order] - BEYOND_M, across[order]
        sides.append(np.interp(stations, along, -across, left=np.nan, right=np.nan))
    there = np.isfinite(sides[0]) & np.isfinite(sides[1])
    middle[there] = (sides[0] + sides[1])[there] / 2
    width[there] = (sides[1] - sides[0])[there]
