"""Geometry of lanes in compiled code: highway-env's road/lane.py, with floating-point operations in its order."""

from __future__ import annotations

import math

import numpy as np

from cavbench.compiled import borrowing, inlined
from cavbench.envs.roads.network import CAR_LENGTH, NEAR, SURELY, LaneKind, LaneRecord
from cavbench.envs.roads.state import Body, Road

STRAIGHT, SINE, CIRCULAR = int(LaneKind.STRAIGHT), int(LaneKind.SINE), int(LaneKind.CIRCULAR)
TWO_PI = 2 * np.pi
NO_LANE = -1


@borrowing
def wrap_to_pi(angle: float) -> float:
    """highway_env.utils.wrap_to_pi: `angle` in [-pi, pi); the cases give the bits of the remainder without a division."""
    shifted = angle + np.pi
    if 0.0 <= shifted < TWO_PI:
        return shifted - np.pi
    if TWO_PI <= shifted < 2 * TWO_PI:
        return (shifted - TWO_PI) - np.pi
    if -TWO_PI < shifted < 0.0:
        return (shifted + TWO_PI) - np.pi
    return shifted % TWO_PI - np.pi


@borrowing
def local_coordinates(lane: LaneRecord, x: float, y: float) -> tuple[float, float]:
    """AbstractLane.local_coordinates: m along the lane, and m to the right of its centre."""
    if lane.kind == CIRCULAR:
        off_x, off_y = x - lane.center_x, y - lane.center_y
        angle = lane.start_phase + wrap_to_pi(math.atan2(off_y, off_x) - lane.start_phase)
        distance = math.sqrt(off_x * off_x + off_y * off_y)
        return lane.turn * (angle - lane.start_phase) * lane.radius, lane.turn * (lane.radius - distance)
    off_x, off_y = x - lane.start_x, y - lane.start_y
    along = off_x * lane.direction_x + off_y * lane.direction_y
    across = off_x * -lane.direction_y + off_y * lane.direction_x
    if lane.kind == SINE:
        across -= lane.amplitude * math.sin(lane.pulsation * along + lane.phase)
    return along, across


@borrowing
def position(lane: LaneRecord, along: float, across: float) -> tuple[float, float]:
    """AbstractLane.position: the point x, y."""
    if lane.kind == CIRCULAR:
        angle = lane.turn * along / lane.radius + lane.start_phase
        distance = lane.radius - across * lane.turn
        return lane.center_x + distance * math.cos(angle), lane.center_y + distance * math.sin(angle)
    if lane.kind == SINE:
        across += lane.amplitude * math.sin(lane.pulsation * along + lane.phase)
    x = lane.start_x + along * lane.direction_x + across * -lane.direction_y
    return x, lane.start_y + along * lane.direction_y + across * lane.direction_x


@borrowing
def heading_at(lane: LaneRecord, along: float) -> float:
    """AbstractLane.heading_at in rad."""
    if lane.kind == CIRCULAR:
        return lane.turn * along / lane.radius + lane.start_phase + np.pi / 2 * lane.turn
    if lane.kind == SINE:
        swing = lane.amplitude * lane.pulsation * math.cos(lane.pulsation * along + lane.phase)
        return lane.heading + math.atan(swing)
    return lane.heading


@borrowing
def is_on(lane: LaneRecord, along: float, across: float, margin: float) -> bool:
    """AbstractLane.on_lane: whether local coordinates are on the lane, widened by `margin` m on both sides."""
    near = abs(across) <= lane.width / 2 + margin
    return near and -CAR_LENGTH <= along < lane.length + CAR_LENGTH


@borrowing
def coordinates_on_other(road: Road, body: Body, number: int) -> tuple[float, float]:
    """The same on a lane that is not its own; until the body moves, those on one of them are stored."""
    if number == body.other_lane:
        return body.other_along, body.other_across
    lane = road.lanes[number]
    along, across = local_coordinates(lane, body.x, body.y)
    if lane.kind != STRAIGHT:
        body.other_lane, body.other_along, body.other_across = number, along, across
    return along, across


@inlined
def coordinates_on(road: Road, body: Body, number: int) -> tuple[float, float]:
    """Local coordinates of a body on a lane; on its own lane they are stored."""
    if number == body.lane:
        return body.along, body.across
    return coordinates_on_other(road, body, number)


@borrowing
def is_reachable(road: Road, body: Body, number: int) -> bool:
    """AbstractLane.is_reachable_from: whether a body may change to a lane."""
    lane = road.lanes[number]
    if lane.forbidden:
        return False
    along, across = coordinates_on(road, body, number)
    return abs(across) <= 2 * lane.width and 0 <= along < lane.length + CAR_LENGTH


@borrowing
def distance_to(lane: LaneRecord, x: float, y: float) -> float:
    """AbstractLane.distance: L1 distance in m of a point."""
    along, across = local_coordinates(lane, x, y)
    return abs(across) + max(along - lane.length, 0.0) + max(0.0 - along, 0.0)


@inlined
def heading_distance(lane: LaneRecord, x: float, y: float, heading: float, least: float) -> tuple[float, float, float]:
    """AbstractLane.distance_with_heading: distance in m plus angle in rad, then the local coordinates.

    The distance is inf if it is surely larger than `least`; that is found without trigonometry.
    """
    if lane.kind == CIRCULAR:
        off_x, off_y = x - lane.center_x, y - lane.center_y
        across = lane.turn * (lane.radius - math.sqrt(off_x * off_x + off_y * off_y))
        if abs(across) > least + SURELY:
            return np.inf, 0.0, 0.0
        angle = lane.start_phase + wrap_to_pi(math.atan2(off_y, off_x) - lane.start_phase)
        along = lane.turn * (angle - lane.start_phase) * lane.radius
    else:
        off_x, off_y = x - lane.start_x, y - lane.start_y
        along = off_x * lane.direction_x + off_y * lane.direction_y
        across = off_x * -lane.direction_y + off_y * lane.direction_x
        if abs(across) - abs(lane.amplitude) + max(along - lane.length, 0.0) + max(-along, 0.0) > least + SURELY:
            return np.inf, 0.0, 0.0
        if lane.kind == SINE:
            across -= lane.amplitude * math.sin(lane.pulsation * along + lane.phase)
    apart = abs(across) + max(along - lane.length, 0.0) + max(0.0 - along, 0.0)
    if apart > least + SURELY:
        return np.inf, 0.0, 0.0
    return apart + abs(wrap_to_pi(heading - heading_at(lane, along))), along, across


@borrowing
def update_lane(body: Body, road: Road) -> None:
    """RoadNetwork.get_closest_lane_index: set the lane of a body and its place on it; the first lane wins a tie.

    The lane of the frame before is tried first. While the body is close to it, only the lanes near that one may be closer,
    and none where that lane is alone: there all others are farther than `NEAR`.
    """
    best = before = body.lane
    lane = road.lanes[before]
    least, along, across = heading_distance(lane, body.x, body.y, body.heading, np.inf)
    close = least <= NEAR
    alone = close and lane.alone_from <= along <= lane.alone_to
    for place in range(0 if alone else road.lane_count):
        number: int = np.int64(road.near[before, place]) if close else place  # type: ignore[assignment]
        if number < 0:
            break
        if number != before:
            apart, s, r = heading_distance(road.lanes[number], body.x, body.y, body.heading, least)
            if apart < least or (apart == least and number < best):
                best, least, along, across = number, apart, s, r
    body.lane, body.along, body.across = best, along, across
    body.other_lane = NO_LANE


@inlined
def is_after_end(road: Road, body: Body, number: int) -> bool:
    """AbstractLane.after_end: whether a body is on the last half car length of a lane, or beyond."""
    along, _ = coordinates_on(road, body, number)
    return along > road.lanes[number].length - CAR_LENGTH / 2
