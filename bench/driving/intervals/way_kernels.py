"""Compiled loops over the episodes: the ego on a way that bends. float64 inside, states are float32."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, inner
from cavbench.driving.intervals.kernels import Floats
from cavbench.driving.intervals.motion_kernels import EDGE, HEADING, KNOWN, LANE, SLACK, SPEED, TARGET, Car
from cavbench.driving.intervals.motion_kernels import Y as OFFSET

STATION = 7
"""A further field of a state on a way: the station in m."""
PURSUIT_S = 0.1
"""highway-env's cars steer towards the direction that the lane will have after this time (TAU_PURSUIT of controller.py)."""
END_M = 2.5
"""They follow the next stretch from so far before the end of a lane on (AbstractLane.after_end of road/lane.py)."""
LOST_M = 30.0
"""A station that contradicts the measurement is looked for so far to both sides, in m."""


class Route(NamedTuple):
    """A `Way` as the compiled loops take it.

    Args:
        rows: of each stretch x, y, heading, length, curvature and station, [P, 6].
        lanes, start, start_lane: as there.
        lane_width: in m.
    """

    rows: NDArray[np.float64]
    lanes: int
    start: float
    start_lane: int
    lane_width: float


@inner
def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi


@inner
def _stretch(route: Route, station: float) -> int:
    """The stretch at a station."""
    found = 0
    for number in range(len(route.rows)):
        if station >= route.rows[number, 5]:
            found = number
    return found


@inner
def _point(route: Route, station: float, offset: float) -> tuple[float, float, float]:
    """The point x, y of a place, and the direction of the way there."""
    row = route.rows[_stretch(route, station)]
    along, curvature = station - row[5], row[4]
    heading = row[2] + curvature * along
    if curvature == 0.0:
        x, y = row[0] + along * math.cos(row[2]), row[1] + along * math.sin(row[2])
    else:
        x = row[0] + (math.sin(heading) - math.sin(row[2])) / curvature
        y = row[1] - (math.cos(heading) - math.cos(row[2])) / curvature
    return x - offset * math.sin(heading), y + offset * math.cos(heading), heading


@inner
def _local(route: Route, number: int, x: float, y: float) -> tuple[float, float]:
    """A point as m along a stretch, however far it is, and its offset."""
    row = route.rows[number]
    sin, cos, curvature = math.sin(row[2]), math.cos(row[2]), row[4]
    dx, dy = x - row[0], y - row[1]
    if curvature == 0.0:
        return dx * cos + dy * sin, dy * cos - dx * sin
    turn, radius = math.copysign(1.0, curvature), 1 / abs(curvature)
    # From the centre, which is to the right of a turn to the right.
    dx, dy = dx + turn * radius * sin, dy - turn * radius * cos
    middle = row[3] / 2
    turned = _wrapped(math.atan2(dy, dx) - (row[2] + curvature * middle - turn * math.pi / 2))
    return turn * turned * radius + middle, turn * (radius - math.hypot(dx, dy))


@inner
def _place(route: Route, number: int, x: float, y: float) -> tuple[float, float]:
    """Station and offset of a point on or next to a stretch."""
    last = len(route.rows) - 1
    along, offset = _local(route, number, x, y)
    if along < 0 and number > 0:
        number -= 1
        along, offset = _local(route, number, x, y)
    elif along > route.rows[number, 3] and number < last:
        number += 1
        along, offset = _local(route, number, x, y)
    return route.rows[number, 5] + along, offset


@inner
def slip(curvature: float, car: Car) -> float:
    """By how much a car that follows a curve points to the outside of where it moves, in rad: the bicycle model."""
    return math.asin(min(max(float(car.half_length) * curvature, -1.0), 1.0))


@inner
def _beside(low: float, value: float, high: float) -> float:
    return max(low - value, value - high, 0.0)


@inner
def _apart(route: Route, station: float, offset: float, low: Floats, high: Floats) -> float:
    """How far a place is from a box, in m, by the larger one of x and y."""
    x, y, _ = _point(route, station, offset)
    return max(_beside(low[0], x, high[0]), _beside(low[1], y, high[1]))


@inner
def _found(route: Route, station: float, offset: float, low: Floats, high: Floats) -> float:
    """The station around a given one that is nearest to a measured box."""
    best, least = station, np.inf
    for number in range(-round(LOST_M), round(LOST_M) + 1):
        apart = _apart(route, station + number, offset, low, high)
        if apart < least:
            best, least = station + number, apart
    return best


@entry_point
def corrected(states: Floats, low: Floats, high: Floats, car: Car, route: Route, now: Floats) -> None:
    """The egos at an observation; fills `now` [N, 8], states.

    Args:
        states: the predicted egos [N, 8].
        low, high: the box of the measured row, x, y, vx and vy in the frame of the world, [N, 4].
        car: the kinematics.
        route: the way.
    """
    for n in range(len(states)):
        now[n] = states[n]
        if not states[n, KNOWN] > 0:
            now[n, OFFSET], now[n, HEADING], now[n, SPEED] = route.start_lane * route.lane_width, 0.0, car.start_speed
            now[n, LANE], now[n, TARGET], now[n, EDGE] = route.start_lane, car.start_speed, route.lanes - 1
            now[n, STATION] = route.start
            continue
        station, offset = float(states[n, STATION]), float(states[n, OFFSET])
        if _apart(route, station, offset, low[n], high[n]) > SLACK:
            now[n, STATION] = _found(route, station, offset, low[n], high[n])
        _, _, heading = _point(route, station, offset)
        heading += states[n, HEADING] - slip(route.rows[_stretch(route, station), 4], car)
        cos, sin = math.cos(heading), math.sin(heading)
        least = cos * (low[n, 2] if cos > 0 else high[n, 2]) + sin * (low[n, 3] if sin > 0 else high[n, 3])
        most = cos * (high[n, 2] if cos > 0 else low[n, 2]) + sin * (high[n, 3] if sin > 0 else low[n, 3])
        if not math.isnan(least + most):
            now[n, SPEED] = min(max(float(states[n, SPEED]), least - SLACK), most + SLACK)


@entry_point
def driven(states: Floats, orders: NDArray[np.int64], turns: NDArray[np.int64], car: Car, route: Route) -> None:
    """The egos, states [N, 8], one decision later, in place.

    Args:
        states: the egos now.
        orders: 1 for FASTER, -1 for SLOWER, 0 for another action, [N].
        turns: 1 for LANE_RIGHT, -1 for LANE_LEFT, 0 for another action, [N].
        car: the kinematics.
        route: the way.
    """
    top = float(car.last)
    for n in range(len(states)):
        ego = states[n]
        if orders[n] != 0:
            index = min(max(np.rint((ego[SPEED] - car.lowest) / car.range * top), 0.0), top) + orders[n]
            ego[TARGET] = car.lowest + min(max(index, 0.0), top) * car.spacing
        lane = min(max(ego[LANE] + turns[n], 0.0), float(ego[EDGE]))
        # A lane farther away than two lane widths cannot be chosen (highway-env's AbstractLane.is_reachable_from).
        if abs(ego[OFFSET] - route.lane_width * lane) <= 2 * route.lane_width:
            ego[LANE] = lane
        station = float(ego[STATION])
        number = _stretch(route, station)
        x, y, heading = _point(route, station, float(ego[OFFSET]))
        heading += ego[HEADING] - slip(route.rows[number, 4], car)
        speed = float(ego[SPEED])
        for _ in range(car.frames):
            steering = _steering(route, number, station, x, y, heading, speed, float(ego[LANE]), car)
            acceleration = float(car.speed_gain) * (ego[TARGET] - speed)
            if speed > car.top_speed:
                acceleration = min(acceleration, car.top_speed - speed)
            sideways = math.atan(0.5 * math.tan(steering))
            x += speed * math.cos(heading + sideways) * car.dt
            y += speed * math.sin(heading + sideways) * car.dt
            heading += speed * math.sin(sideways) / car.half_length * car.dt
            speed += acceleration * car.dt
            station, offset = _place(route, number, x, y)
            number = _stretch(route, station)
            ego[OFFSET] = offset
        _, _, direction = _point(route, station, 0.0)
        ego[HEADING] = _wrapped(heading - direction) + slip(route.rows[number, 4], car)
        ego[SPEED], ego[STATION], ego[KNOWN] = speed, station, 1.0


@inner
def _steering(
    route: Route, number: int, station: float, x: float, y: float, heading: float, speed: float, lane: float, car: Car
) -> float:
    """ControlledVehicle.steering_control towards the middle of a lane, in rad."""
    middle = lane * route.lane_width
    row = route.rows[number]
    if (row[3] - (station - row[5])) * (1 - row[4] * middle) < END_M:
        number = min(number + 1, len(route.rows) - 1)
        row = route.rows[number]
    along, offset = _local(route, number, x, y)
    ahead = row[2] + row[4] * (along + speed * PURSUIT_S / (1 - row[4] * middle))
    moving = speed if abs(speed) > 0.01 else 0.01
    share = min(max(-car.lateral_gain * (offset - middle) / moving, -1.0), 1.0)
    wanted = ahead + min(max(math.asin(share), -car.max_heading), car.max_heading)
    rate = car.heading_gain * _wrapped(wanted - heading)
    sideways = math.asin(min(max(car.half_length / moving * rate, -1.0), 1.0))
    return min(max(math.atan(2 * math.tan(sideways)), -float(car.max_steering)), float(car.max_steering))
