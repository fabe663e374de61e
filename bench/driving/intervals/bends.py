"""A road that bends, straightened: boxes in x and y are enclosed by boxes along and across the way of the ego.

A straightened box has the station along the left lane, the offset to its right, and the speeds along and across the way. As
elsewhere, the rows of other cars are relative to the ego. The ego's own row holds its reckoned station.

The enclosure is sound for every car whose centre is on the road or at most `ASIDE` m beside it. One that is nowhere on the road
counts on all lanes, standing, at its straight distance: no way along the road is shorter.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cavbench.driving.features import ActionType
from cavbench.driving.intervals import motion_kernels, way_kernels
from cavbench.driving.intervals.boxes import Assumed, Boxes, flat, shaped
from cavbench.driving.intervals.ego import DeadReckoning, Ego, Step, stacked
from cavbench.driving.intervals.way_kernels import PURSUIT_S, STATION
from cavbench.driving.kinematics import Kinematics
from cavbench.driving.way import Way

ASIDE = 1.0
"""A car on the road has its centre at most this far beside the outermost lanes, in m."""
FAR = 1e3
"""Beyond every road, in m."""
ROUNDING = 0.01
"""Enclosures are wider by this on every side, in m and m/s: float32, and what a reckoned ego may be wrong by."""
ONWARD = 50.0
"""Bends as far ahead of a car, in m, count for what it will drive."""
REMEMBERED = 6
"""Number of cars out of sight that the tracker remembers."""
IN_SIGHT, ROUND = -8.0, math.pi - 0.1
"""A car that is less behind than this along the ego's lane is surely seen, in m (BEHIND of highway-env's observation is -10), if
it is not farther round a circular lane than this, in rad from where the lane begins."""
CREEPING, BLIND = 1.0, 2.0
"""From a bend the ego sees nothing beyond its end until it is there. Up to a car's length and `BLIND` m behind the end, a car out
of sight is assumed to drive at least at `CREEPING` m/s, if it may be as fast. Else the ego would wait for it for ever."""


class Table(NamedTuple):
    """The stretches, [P] each."""

    x: Tensor
    y: Tensor
    heading: Tensor
    curvature: Tensor
    station: Tensor
    begin: Tensor
    end: Tensor
    length: Tensor


def _table(way: Way, like: Tensor) -> Table:
    """The stretches, in the type and on the device of a tensor."""
    return Table(*(column.to(like) for column in _columns(way)))


@cache
def _columns(way: Way) -> Table:
    """The stretches; `begin` and `end` are where each ends along itself, in m: the way goes on beyond both of its ends."""
    rows = [(one.x, one.y, one.heading, one.curvature, at) for one, at in zip(way.stretches, way.stations, strict=True)]
    lengths = [one.length for one in way.stretches]
    begin, end = [-FAR, *[0.0] * (len(lengths) - 1)], [*lengths[:-1], FAR]
    return Table(*torch.tensor(rows).unbind(-1), *map(torch.tensor, (begin, end, lengths)))


@cache
def _route(way: Way, lane_width: float) -> way_kernels.Route:
    rows = [
        (one.x, one.y, one.heading, one.length, one.curvature, at)
        for one, at in zip(way.stretches, way.stations, strict=True)
    ]
    return way_kernels.Route(np.array(rows), way.lanes, way.start, way.start_lane, lane_width)


def _within(values: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the largest of the values [..., P] that are valid; without one, the other way round."""
    big = torch.full_like(values, torch.inf)
    return torch.where(valid, values, big).amin(-1), torch.where(valid, values, -big).amax(-1)


class Enclosure(NamedTuple):
    """Bounds along every stretch [..., P], and whether the box reaches it.

    Args:
        valid: bool [..., P].
        along: from the beginning of the stretch, in m.
        offset: to the right of the left lane, in m.
    """

    valid: Tensor
    along: tuple[Tensor, Tensor]
    offset: tuple[Tensor, Tensor]


def enclosed(way: Way, lane_width: float, low: Tensor, high: Tensor) -> Enclosure:
    """Where on the road a point may be that is in a rectangle.

    Along a straight stretch both coordinates are linear, so the corners have the extremes. Around the centre of an arc the
    largest distance is that of a corner, the least one that of the rectangle, and without the centre in it the corners have the
    extreme angles.

    Args:
        way: the way.
        lane_width: in m.
        low, high: x and y of the rectangle, in m, [..., 2].
    """
    table = _table(way, low)
    x = torch.stack([low[..., 0], low[..., 0], high[..., 0], high[..., 0]], -1).unsqueeze(-2)
    y = torch.stack([low[..., 1], high[..., 1], low[..., 1], high[..., 1]], -1).unsqueeze(-2)
    cos, sin = table.heading.cos().unsqueeze(-1), table.heading.sin().unsqueeze(-1)
    dx, dy = x - table.x.unsqueeze(-1), y - table.y.unsqueeze(-1)
    along, across = dx * cos + dy * sin, dy * cos - dx * sin
    bent = table.curvature != 0
    turn, radius = table.curvature.sign(), 1 / torch.where(bent, table.curvature.abs(), 1.0)
    centre = table.x - turn * radius * table.heading.sin(), table.y + turn * radius * table.heading.cos()
    out_x, out_y = x - centre[0].unsqueeze(-1), y - centre[1].unsqueeze(-1)
    middle = table.heading + table.curvature * table.length / 2 - turn * math.pi / 2
    # atan2 has no slope in the centre itself.
    out_y = torch.where((out_x == 0) & (out_y == 0), 1e-6, out_y)
    turned = torch.remainder(torch.atan2(out_y, out_x) - middle.unsqueeze(-1) + math.pi, 2 * math.pi) - math.pi
    turned = turned * turn.unsqueeze(-1)
    least, most = turned.amin(-1), turned.amax(-1)
    # The rectangle lies across the ray opposite to the arc, or around the centre.
    all_round = most - least > math.pi
    least, most = torch.where(all_round, -math.pi, least), torch.where(all_round, math.pi, most)
    near_x = torch.maximum(low[..., :1] - centre[0], centre[0] - high[..., :1]).clamp(min=0)
    near_y = torch.maximum(low[..., 1:] - centre[1], centre[1] - high[..., 1:]).clamp(min=0)
    near, far = (near_x**2 + near_y**2 + 1e-12).sqrt(), (out_x**2 + out_y**2 + 1e-12).sqrt().amax(-1)
    sides = turn * (radius - near), turn * (radius - far)
    along_low = torch.where(bent, least * radius + table.length / 2, along.amin(-1))
    along_high = torch.where(bent, most * radius + table.length / 2, along.amax(-1))
    offset_low = torch.where(bent, torch.minimum(*sides), across.amin(-1))
    offset_high = torch.where(bent, torch.maximum(*sides), across.amax(-1))
    band = -lane_width / 2 - ASIDE - ROUNDING, (way.lanes - 0.5) * lane_width + ASIDE + ROUNDING
    begin, end = table.begin - ROUNDING, table.end + ROUNDING
    valid = (along_low <= end) & (along_high >= begin) & (offset_low <= band[1]) & (offset_high >= band[0])
    return Enclosure(
        valid,
        (torch.maximum(along_low, begin), torch.minimum(along_high, end)),
        (offset_low.clamp(min=band[0]), offset_high.clamp(max=band[1])),
    )


def projected(low: Tensor, high: Tensor, first: Tensor, last: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Bounds of a velocity along and across directions from `first` to `last`, in rad, [..., P]; of along, then of across.

    Args:
        low, high: bounds of the velocity's x and y, [..., 2].
        first, last: the directions, [..., P].
    """
    x = torch.stack([low[..., 0], low[..., 0], high[..., 0], high[..., 0]], -1)
    y = torch.stack([low[..., 1], high[..., 1], low[..., 1], high[..., 1]], -1)
    still = x**2 + y**2 < 1e-10
    x = torch.where(still, 1e-5, x)
    size, angle = (x**2 + y**2).sqrt().unsqueeze(-2), torch.atan2(y, x).unsqueeze(-2)
    first, last = first.unsqueeze(-1), last.unsqueeze(-1)
    along = _cosines(first - angle, last - angle)
    across = _cosines(first - angle + math.pi / 2, last - angle + math.pi / 2)
    return (
        (size * along[0]).amin(-1),
        (size * along[1]).amax(-1),
        (size * across[0]).amin(-1),
        (size * across[1]).amax(-1),
    )


def _cosines(first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the largest cosine of the angles from `first` to `last`."""
    whole = 2 * math.pi
    ends = torch.stack([first.cos(), last.cos()], -1)
    top = (last / whole).floor() >= (first / whole).ceil()
    bottom = ((last - math.pi) / whole).floor() >= ((first - math.pi) / whole).ceil()
    return torch.where(bottom, -1.0, ends.amin(-1)), torch.where(top, 1.0, ends.amax(-1))


def directions(way: Way, station: Tensor) -> tuple[Tensor, Tensor]:
    """The direction of the way at stations [...], in rad, and its curvature there."""
    table, number = _at(way, station)
    curvature = table.curvature[number]
    return table.heading[number] + curvature * (station - table.station[number]), curvature


def points(way: Way, station: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """The points x, y of places [...]."""
    table, number = _at(way, station)
    heading, curvature = directions(way, station)
    along, begins = station - table.station[number], table.heading[number]
    bent = curvature != 0
    safe = torch.where(bent, curvature, 1.0)
    x = torch.where(bent, (heading.sin() - begins.sin()) / safe, along * begins.cos())
    y = torch.where(bent, (begins.cos() - heading.cos()) / safe, along * begins.sin())
    return table.x[number] + x - offset * heading.sin(), table.y[number] + y + offset * heading.cos()


def _at(way: Way, station: Tensor) -> tuple[Table, Tensor]:
    """The stretches, and the number of that at each station [...]."""
    table = _table(way, station)
    return table, ((station.unsqueeze(-1) >= table.station).sum(-1) - 1).clamp(min=0)


def turned(way: Way, station: Tensor) -> Tensor:
    """By how much the way has turned from its beginning to stations [...], in rad."""
    table = _table(way, station)
    part = (station.unsqueeze(-1) - table.station).clamp(min=0).minimum(table.length)
    return (part * table.curvature).sum(-1)


def _curved(way: Way, first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the largest curvature between two stations [...]."""
    table = _table(way, first)
    first, last = first.unsqueeze(-1), last.unsqueeze(-1)
    touched = (last >= table.station + table.begin) & (first <= table.station + table.end)
    return _within(table.curvature.expand_as(touched), touched)


def slip(curvature: Tensor, car: Kinematics) -> Tensor:
    """By how much a car that follows a curve points to the outside of where it moves, in rad: the bicycle model."""
    return (curvature * (car.length / 2)).clamp(-1, 1).asin()


class BentReckoning(DeadReckoning):
    """Dead reckoning on a way. Its states have the station besides, [..., 8].

    The heading of its egos is the direction in which they move, from that of the way: in a bend a car points elsewhere.
    """

    def __init__(
        self, kinematics: Kinematics, period: float, actions: tuple[str, ...], action_type: ActionType
    ) -> None:
        super().__init__(kinematics, period, actions, action_type)
        assert kinematics.way is not None
        self.way = kinematics.way
        self.route = _route(self.way, kinematics.lane_width)

    def unknown(self, episodes: Tensor) -> Tensor:
        return torch.zeros(len(episodes), STATION + 1, device=episodes.device)

    def boxes(self, assumed: Assumed, shown: Tensor, state: Tensor, tracks: Tensor | None = None) -> Boxes:
        measured = assumed.boxes(shown)
        states = self._corrected(measured, state)
        found = _straightened(self.kinematics, measured, states)
        if tracks is None:
            return found
        narrowed, fits = _narrowed(found, tracks, _known(measured))
        return _remembered(narrowed, tracks, fits, self.way)

    def _corrected(self, measured: Boxes, state: Tensor) -> Tensor:
        """The states [..., 8] at an observation, from those that were predicted."""
        leading = measured.present.shape[:-1]
        states = flat(state.expand(*leading, state.shape[-1]), 1)
        own = measured.low[..., 0, :], measured.high[..., 0, :]
        now = np.empty_like(states)
        way_kernels.corrected(states, flat(own[0], 1), flat(own[1], 1), self.car, self.route, now)
        return shaped(now, leading, state)

    def now(self, boxes: Boxes, state: Tensor) -> Ego:
        return _ego(boxes, state, self)

    def step(self, boxes: Boxes, state: Tensor, action: Tensor) -> Step:
        ego = self.now(boxes, state)
        place = torch.stack([torch.ones_like(ego.y), boxes.low[..., 0, 0]], -1)
        states = torch.cat([torch.stack(tuple(ego), -1), place], -1).detach()
        orders, turns = self._changes[:, action.cpu()].numpy()
        moved = flat(states, 1).copy()
        way_kernels.driven(moved, orders, turns, self.car, self.route)
        return Step(ego, shaped(moved, states.shape[:-1], states))

    def after(self, ego: Ego, action: Tensor) -> Tensor:
        raise NotImplementedError("on a way, `step` knows the station")

    def middles(self, boxes: Boxes, rows: int) -> Tensor:
        middle = (boxes.low + boxes.high)[..., :rows, :] / 2
        own, others = middle[..., :1, :], middle[..., 1:, :]
        places = torch.cat([own, others + own], -2)
        direction, curvature = directions(self.way, places[..., 0])
        place = torch.stack(points(self.way, places[..., 0], places[..., 1]), -1)
        speeds = places[..., 2:]
        # The ego's row has the speeds in the direction in which it moves; it points elsewhere.
        points_to = direction[..., :1] - slip(curvature[..., :1], self.kinematics)
        cos, sin = (turn(torch.cat([points_to, direction[..., 1:]], -1)) for turn in (torch.cos, torch.sin))
        velocity = torch.stack(
            [speeds[..., 0] * cos - speeds[..., 1] * sin, speeds[..., 0] * sin + speeds[..., 1] * cos], -1
        )
        seen = torch.cat([place, velocity], -1)
        # A car that is nowhere on the road has no middle.
        nowhere = boxes.high[..., 1:rows, :1] > FAR / 2
        return torch.cat([seen[..., :1, :], torch.where(nowhere, torch.inf, seen[..., 1:, :] - seen[..., :1, :])], -2)

    def corrected(self, observation: Tensor, ego: Ego, boxes: Boxes, assumed: Assumed) -> Tensor:
        station = boxes.low[..., 0, 0]
        direction, curvature = directions(self.way, station)
        heading = direction + ego.heading - slip(curvature, self.kinematics)
        place = points(self.way, station, ego.y)
        own = torch.stack([*place, ego.speed * heading.cos(), ego.speed * heading.sin()], -1)
        row = torch.cat((observation[..., 0, :1], assumed.normalised(own)), -1)
        return torch.cat((row.unsqueeze(-2), observation[..., 1:, :]), -2)


def _ego(boxes: Boxes, state: Tensor, of: BentReckoning) -> Ego:
    """The ego at an observation, from its row; what it aims for, from its state."""
    low = boxes.low[..., 0, :]
    known = state[..., motion_kernels.KNOWN] > 0
    lane = torch.where(known, state[..., motion_kernels.LANE], (low[..., 1] / of.kinematics.lane_width).round())
    start = of.kinematics.start_speed
    return Ego(
        y=low[..., 1],
        heading=state[..., motion_kernels.HEADING].expand_as(lane),
        speed=(low[..., 2] ** 2 + low[..., 3] ** 2 + 1e-12).sqrt(),
        target_lane=lane,
        target_speed=torch.where(known, state[..., motion_kernels.TARGET], 0.0 if start is None else start),
        edge=torch.full_like(lane, of.way.lanes - 1),
    )


def _straightened(car: Kinematics, measured: Boxes, states: Tensor) -> Boxes:
    """The boxes of a measurement, straightened.

    Args:
        car: the kinematics, with a way.
        measured: x, y, vx and vy in the frame of the world; those of others from the ego's.
        states: the ego, [..., 8].
    """
    way = car.way
    assert way is not None
    station, offset = states[..., STATION], states[..., motion_kernels.Y]
    speed, course = states[..., motion_kernels.SPEED], states[..., motion_kernels.HEADING]
    direction, curvature = directions(way, station)
    heading = direction + course - slip(curvature, car)
    place = torch.stack(points(way, station, offset), -1).unsqueeze(-2)
    velocity = (speed.unsqueeze(-1) * torch.stack([heading.cos(), heading.sin()], -1)).unsqueeze(-2)
    low, high = measured.low[..., 1:, :].clamp(min=-FAR), measured.high[..., 1:, :].clamp(max=FAR)
    least, most = low[..., :2] + place - ROUNDING, high[..., :2] + place + ROUNDING
    slowest = (low[..., 2:] + velocity - ROUNDING).clamp(min=-car.top_speed)
    fastest = (high[..., 2:] + velocity + ROUNDING).clamp(max=car.top_speed)
    found = enclosed(way, car.lane_width, least, most)
    table = _table(way, low)
    first, last = (table.heading + table.curvature * bound for bound in found.along)
    speeds = projected(slowest, fastest, torch.minimum(first, last), torch.maximum(first, last))
    begins, ends = (table.station + bound - station[..., None, None] for bound in found.along)
    pairs = ((begins, ends), found.offset, speeds[:2], speeds[2:])
    bounds = [[_within(pair[side], found.valid)[side] for pair in pairs] for side in (0, 1)]
    # Nowhere on the road: on all lanes, standing, no farther along the road than it is.
    nearest = torch.maximum(least - place, place - most).clamp(min=0)
    beside = ASIDE + car.lane_width / 2
    lost = (
        ((nearest**2).sum(-1).add(1e-12).sqrt(), -beside, 0.0, 0.0),
        (FAR, (way.lanes - 1) * car.lane_width + beside, 0.0, 0.0),
    )
    on_road = found.valid.any(-1)
    own = torch.stack([torch.zeros_like(station), offset, speed * course.cos(), speed * course.sin()], -1).unsqueeze(-2)
    row = torch.cat([station[..., None, None], own[..., 1:]], -1)
    sides = []
    for known, other in zip(bounds, lost, strict=True):
        columns = [
            torch.where(on_road, bound, torch.as_tensor(value).to(bound))
            for bound, value in zip(known, other, strict=True)
        ]
        sides.append(torch.cat([row, torch.stack(columns, -1) - own], -2))
    return Boxes(measured.present, *sides)


def _known(measured: Boxes) -> Tensor:
    """Which of the other cars cannot be new, bool [..., V - 1].

    The rows are the nearest cars in the range of the sensor. So a new one is the farthest of all, or the last one of full rows.
    """
    nearest = torch.maximum(measured.low[..., 1:, :2], -measured.high[..., 1:, :2]).clamp(min=0).norm(dim=-1)
    furthest = torch.maximum(measured.high[..., 1:, :2], -measured.low[..., 1:, :2]).norm(dim=-1)
    others = torch.where(measured.present[..., 1:], nearest, 0.0)
    known = furthest < others.amax(-1, keepdim=True)
    known[..., -1] = False
    return known


def _narrowed(found: Boxes, tracks: Tensor, known: Tensor) -> tuple[Boxes, Tensor]:
    """The boxes of other cars, each intersected with the hull of all tracks that it may belong to (`box_kernels.narrow`).

    Besides, bool [..., K], which tracks a box may belong to.

    Args:
        found: straightened boxes [..., V, 4].
        tracks: of `predicted`, [..., K, 9].
        known: bool [..., V - 1], the cars that cannot be new.
    """
    low, high = found.low[..., 1:, :], found.high[..., 1:, :]
    least, most = tracks[..., 1:5], tracks[..., 5:]
    meets = (low.unsqueeze(-2) <= most.unsqueeze(-3)) & (least.unsqueeze(-3) <= high.unsqueeze(-2))
    may_be = meets.all(-1) & (tracks[..., 0] > 0).unsqueeze(-2) & found.present[..., 1:].unsqueeze(-1)
    fits = may_be & known.unsqueeze(-1)
    inf = torch.full_like(least, torch.inf).unsqueeze(-3)
    least = torch.where(fits.unsqueeze(-1), least.unsqueeze(-3), inf).amin(-2)
    most = torch.where(fits.unsqueeze(-1), most.unsqueeze(-3), -inf).amax(-2)
    lower, upper = torch.maximum(low, least), torch.minimum(high, most)
    common = fits.any(-1, keepdim=True) & (lower <= upper)
    low, high = torch.where(common, lower, low), torch.where(common, upper, high)
    boxes = Boxes(
        found.present,
        torch.cat([found.low[..., :1, :], low], -2),
        torch.cat([found.high[..., :1, :], high], -2),
    )
    return boxes, may_be.any(-2)


def _remembered(boxes: Boxes, tracks: Tensor, found: Tensor, way: Way) -> Boxes:
    """The boxes with `REMEMBERED` rows more: the nearest cars ahead that were seen, are not now, and may be out of sight.

    They are known by their speed across the way, which is exactly 0.

    Args:
        boxes: straightened boxes [..., V, 4].
        tracks: of `predicted`, [..., K, 9].
        found: bool [..., K], which tracks are seen now.
        way: the way.
    """
    station, offset = boxes.low[..., 0, 0], boxes.low[..., 0, 1]
    first, last = station.unsqueeze(-1) + tracks[..., 1], station.unsqueeze(-1) + tracks[..., 5]
    beside = offset.unsqueeze(-1) + (tracks[..., 2] + tracks[..., 6]) / 2
    hidden = _hidden(way, station, offset, torch.stack([first, (first + last) / 2, last], -1), beside)
    kept = (tracks[..., 0] > 0) & ~found & hidden & (tracks[..., 1] > 0)
    order = torch.where(kept, tracks[..., 1], torch.inf).sort(stable=True, dim=-1).indices[..., :REMEMBERED]
    rows = tracks.gather(-2, order.unsqueeze(-1).expand(*order.shape, tracks.shape[-1])).clone()
    # Who is not seen, is not where the ego sees everyone: in its bend, unless the rows are full.
    bent, end = _bend(way, station.detach())
    seen = torch.where(bent & ~boxes.present[..., -1], end - ROUNDING, -FAR).unsqueeze(-1)
    rows[..., 1], rows[..., 5] = rows[..., 1].maximum(seen), rows[..., 5].maximum(seen)
    rows[..., 4] = rows[..., 8] = -boxes.low[..., :1, 3]
    return Boxes(
        torch.cat([boxes.present, kept.gather(-1, order)], -1),
        torch.cat([boxes.low, rows[..., 1:5]], -2),
        torch.cat([boxes.high, rows[..., 5:]], -2),
    )


def _hidden(way: Way, station: Tensor, offset: Tensor, stations: Tensor, beside: Tensor) -> Tensor:
    """Whether a car may be out of the sight of highway-env's ego, bool [..., K].

    It sees what is ahead of it along its own lane, and little behind. A circular lane goes on as a circle: from a half circle
    nothing is seen beyond its end.

    Args:
        way: the way.
        station, offset: the place of the ego, [...].
        stations: of each car the first, the middle and the last one, [..., K, 3].
        beside: their offsets, [..., K].
    """
    table, number = _at(way, station)
    heading, curvature, at = table.heading[number], table.curvature[number], station - table.station[number]
    x, y = points(way, stations, beside.unsqueeze(-1))
    sin, cos = heading.sin()[..., None, None], heading.cos()[..., None, None]
    dx, dy = x - table.x[number][..., None, None], y - table.y[number][..., None, None]
    turn, radius = (
        curvature.sign()[..., None, None],
        1 / torch.where(curvature == 0, 1.0, curvature.abs())[..., None, None],
    )
    # From the centre, in the direction of the beginning and across it.
    outwards, onwards = turn * (dx * sin - dy * cos) + radius, dx * cos + dy * sin
    angle = torch.atan2(onwards, outwards)
    bent = (curvature != 0)[..., None, None]
    along = torch.where(bent, angle * radius, onwards) - at[..., None, None]
    longer = (1 - curvature * offset)[..., None, None]
    return ((along * longer < IN_SIGHT) | (bent & (angle > ROUND))).any(-1)


def cut(car: Kinematics) -> float:
    """By how much highway-env's controllers let a car cut the sharpest bend at its highest target speed, in m.

    A car at speed v in a bend of curvature c turns at the rate v c, which the heading's gain answers 1 / gain s late, and the
    lane's direction is known `PURSUIT_S` ahead. The rest must come from the distance to the lane, times its gain.
    """
    assert car.way is not None
    late = max(1 / car.heading_gain - PURSUIT_S, 0.0)
    return car.target_speeds[-1] ** 2 * car.way.sharpest * late / car.lateral_gain


def lengthened(car: Kinematics) -> float:
    """By how much more than its length a car takes up of the innermost path of the sharpest bend, in m.

    Two cars on a circle touch with the corners of their inner sides first.
    """
    assert car.way is not None
    outermost = (car.way.lanes - 1) * car.lane_width
    longest = max(abs(one.curvature) / (1 - max(one.curvature * outermost, 0.0)) for one in car.way.stretches)
    if longest == 0:
        return 0.0
    radius = 1 / longest - cut(car)
    return 2 * radius * math.atan(car.length / 2 / (radius - car.width / 2)) - car.length


def paths(ego: Ego, boxes: Boxes, car: Kinematics) -> tuple[Tensor, Tensor]:
    """Bounds of the other cars as a straight road has them, [..., V - 1, 4]: x, y, vx and vy, of which x is from the ego.

    In a bend the way along one lane is longer than along another. So x and vx are bounds over all paths between the ego's and
    the car's, and `cut` beyond those of the car: on the path at offset d, stations s and s' are s' - s - d (h' - h) apart, where
    h is the direction of the way.
    """
    way = car.way
    assert way is not None
    own = torch.stack([torch.zeros_like(ego.y), ego.y, *_speeds(ego)], -1).unsqueeze(-2)
    low, high = boxes.low[..., 1:, :] + own, boxes.high[..., 1:, :] + own
    station = boxes.low[..., :1, 0]
    cuts, offset = cut(car), ego.y.unsqueeze(-1)
    left, right = torch.minimum(low[..., 1] - cuts, offset), torch.maximum(high[..., 1] + cuts, offset)
    near, far = station + low[..., 0], station + high[..., 0]
    least, most = _curved(way, near, far + ONWARD)
    between = _curved(way, torch.minimum(station, near), torch.maximum(station, far))
    bends = torch.maximum(between[1], most).clamp(min=0) - torch.minimum(between[0], least).clamp(max=0)
    bent = turned(way, torch.stack([near, far], -1)) - turned(way, station).unsqueeze(-1)
    lengths = torch.stack([low[..., 0], high[..., 0]], -1).unsqueeze(-2)
    lengths = lengths - torch.stack([left, right], -1).unsqueeze(-1) * bent.unsqueeze(-2)
    longer = lengthened(car) * (bends > 0)
    x_low, x_high = lengths[..., 0].amin(-1) - longer, lengths[..., 1].amax(-1) + longer
    # As fast as the car goes on its own path, it goes by less along a longer one.
    to_left, to_right = left - high[..., 1], right - low[..., 1]
    shares = [
        1 - curvature * beside / (1 - curvature * at)
        for curvature in (least, most, torch.zeros_like(least))
        for beside in (to_left, to_right)
        for at in (low[..., 1], high[..., 1])
    ]
    share = torch.stack(shares, -1)
    slower, faster = share.amin(-1).clamp(min=0), share.amax(-1)
    vx_low = torch.where(low[..., 2] >= 0, low[..., 2] * slower, low[..., 2] * faster)
    vx_high = torch.where(high[..., 2] >= 0, high[..., 2] * faster, high[..., 2] * slower)
    # A car in a bend points to the outside of where it moves.
    here = _curved(way, near, far)
    slips = torch.stack([speed * slip(one, car).sin() for speed in (low[..., 2], high[..., 2]) for one in here], -1)
    vy_low, vy_high = low[..., 3] + slips.amin(-1), high[..., 3] + slips.amax(-1)
    return (
        torch.stack([x_low, low[..., 1], vx_low, vy_low], -1),
        torch.stack([x_high, high[..., 1], vx_high, vy_high], -1),
    )


def _speeds(ego: Ego) -> tuple[Tensor, Tensor]:
    return ego.speed * ego.heading.cos(), ego.speed * ego.heading.sin()


def predicted(boxes: Boxes, before: Ego, after: Tensor, car: Kinematics, limits: motion_kernels.Limits) -> Tensor:
    """`tracks.predicted` on a way: the other cars one decision later, [B, V - 1, 9], without a gradient.

    The compiled loop moves them as on a straight road. What the bend changes comes on top: the direction of the way turns under
    a car by its speed times the curvature, and a metre of its path is 1 / (1 - c d) m of the left lane, at the offset d.
    """
    way = car.way
    assert way is not None
    period = float(limits.period)
    row = boxes.low[:, 0].detach(), boxes.high[:, 0].detach()
    station, own = row[0][:, 0], row[0][:, None, 1:]
    low, high = boxes.low[:, 1:].detach(), boxes.high[:, 1:].detach()
    absolute = low[..., 1:] + own, high[..., 1:] + own
    largest = torch.maximum(absolute[0].abs(), absolute[1].abs())
    fastest = torch.hypot(largest[..., 1], largest[..., 2]) + float(limits.gained)
    reach = car.top_speed * period + ROUNDING
    curvatures = _curved(way, station[:, None] + low[..., 0] - reach, station[:, None] + high[..., 0] + reach)
    sides = absolute[0][..., 0] - ASIDE, absolute[1][..., 0] + ASIDE
    shares = torch.stack([1 / (1 - one * side).clamp(min=0.1) for one in curvatures for side in sides], -1)
    least, most = shares.amin(-1), shares.amax(-1)
    turn = torch.maximum(curvatures[0].abs(), curvatures[1].abs()) * most * fastest * period
    swing = (turn * fastest).unsqueeze(-1) * torch.tensor([0.0, 0.0, 0.0, 1.0])
    given = (
        flat(torch.cat([row[0].unsqueeze(1), low - swing], 1), 2),
        flat(torch.cat([row[1].unsqueeze(1), high + swing], 1), 2),
    )
    tracks = np.empty((len(low), low.shape[1], 9), np.float32)
    motion_kernels.later(flat(boxes.present, 1), *given, stacked(before).numpy(), flat(after, 1), limits, tracks)
    found = torch.from_numpy(tracks)
    # What the loop added to the stations is undone, and added as far as the left lane gets longer by it.
    driven = (before.speed + after[:, motion_kernels.SPEED]) / 2 * before.heading.cos() * period
    moved, slack = after[:, STATION] - station, float(limits.rounding)
    behind = found[..., 1] + driven.unsqueeze(-1) - low[..., 0] + slack
    ahead = found[..., 5] + driven.unsqueeze(-1) - high[..., 0] - slack
    found[..., 1] = low[..., 0] + behind * torch.where(behind >= 0, least, most) - moved.unsqueeze(-1) - slack
    found[..., 5] = high[..., 0] + ahead * torch.where(ahead >= 0, most, least) - moved.unsqueeze(-1) + slack
    # Cars out of sight, which have no speed across the way, keep their lane, and may brake or gain speed as any car. Where one
    # would keep the ego from seeing past its bend, it does not stop.
    now = after[:, motion_kernels.SPEED, None], after[:, motion_kernels.HEADING, None]
    unseen = low[..., 3] == high[..., 3]
    speeds = [(absolute[0][..., 1] - float(limits.gained)).clamp(min=0)]
    speeds.append((absolute[1][..., 1] + float(limits.gained)).clamp(max=car.top_speed))
    for place, side, share in ((2, 0, least), (6, 1, most)):
        further = (low, high)[side][..., 0] + speeds[side] * share * period
        if side == 0:
            crept = (low[..., 0] + CREEPING * least * period).minimum(_in_the_way(car, station).unsqueeze(-1))
            further = torch.where(absolute[1][..., 1] >= CREEPING, further.maximum(crept), further)
        found[..., place - 1] = torch.where(unseen, further - moved.unsqueeze(-1), found[..., place - 1])
        found[..., place + 1] = torch.where(unseen, speeds[side] - now[0] * now[1].cos(), found[..., place + 1])
        found[..., place] = torch.where(
            unseen, absolute[side][..., 0] - after[:, motion_kernels.Y, None], found[..., place]
        )
        found[..., place + 2] = torch.where(unseen, -now[0] * now[1].sin(), found[..., place + 2])
    return found


def _bend(way: Way, station: Tensor) -> tuple[Tensor, Tensor]:
    """Whether stations [...] are in a bend, bool, and how far from them its part ends that is seen from within it, in m.

    Farther round than `ROUND` nobody is surely seen, which is at the end of a half circle.
    """
    table, number = _at(way, station)
    curvature, length = table.curvature[number].abs(), table.length[number]
    seen = torch.minimum(length, ROUND / torch.where(curvature == 0, 1.0, curvature))
    return curvature != 0, table.station[number] + seen - station


def _in_the_way(car: Kinematics, station: Tensor) -> Tensor:
    """How far ahead of stations [...] in a bend a car lets the ego come to where it sees past the bend, in m; else -`FAR`."""
    assert car.way is not None
    table, number = _at(car.way, station)
    end = table.station[number] + table.length[number] - station
    return torch.where(table.curvature[number] != 0, end + car.length + lengthened(car) + BLIND, -FAR)
