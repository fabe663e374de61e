"""The other cars: highway-env's Road.neighbour_vehicles (road/road.py) and IDMVehicle (vehicle/behavior.py)."""

from __future__ import annotations

import math

import numpy as np

from cavbench.compiled import borrowing, inlined, inner
from cavbench.envs.highway.dynamics import MAX_STEERING, clip, not_zero
from cavbench.envs.highway.search import NO_ONE
from cavbench.envs.highway.traffic import (
    LANE_CHANGE_DELAY,
    MAX_ACCELERATION,
)
from cavbench.envs.roads.lanes import CIRCULAR, STRAIGHT, coordinates_on, is_on, is_reachable
from cavbench.envs.roads.motion import follow_road, speed_control, steering_control
from cavbench.envs.roads.network import CAR_LENGTH, SURELY, LaneRecord
from cavbench.envs.roads.power import power
from cavbench.envs.roads.state import PLACE, Bodies, Body, Kind, OnLane, Parameters, Places, Road

TIME_GAP = 1.5
LANE_CHANGE_MIN_GAIN = 0.2
LANE_CHANGE_MAX_BRAKING_IMPOSED = 2.0
UNKNOWN = -1
"""Instead of a number of bodies on a lane: nobody has asked in this frame."""
DISCRETE, CONTINUOUS, IDM, OBSTACLE = int(Kind.DISCRETE), int(Kind.CONTINUOUS), int(Kind.IDM), int(Kind.OBSTACLE)


@borrowing
def is_aside(lane: LaneRecord, x: float, y: float) -> bool:
    """Whether a point is surely not on a lane as wide as neighbours are looked for; without trigonometry."""
    if lane.kind == CIRCULAR:
        off_x, off_y = x - lane.center_x, y - lane.center_y
        square = off_x * off_x + off_y * off_y
        along = off_x * lane.middle_x + off_y * lane.middle_y
        # One comparison instead of three, which cannot be predicted.
        return max(lane.inside - square, square - lane.outside, lane.least_x - along) > 0.0
    across = (y - lane.start_y) * lane.direction_x - (x - lane.start_x) * lane.direction_y
    return abs(across) - abs(lane.amplitude) > lane.width / 2 + lane.margin + SURELY


@inlined
def place_on(road: Road, body: Body, number: int) -> tuple[bool, float]:
    """Whether a body is on a lane or within its margin, and where, in m."""
    lane = road.lanes[number]
    if (number != body.lane) & is_aside(lane, body.x, body.y):
        return False, 0.0
    along, across = coordinates_on(road, body, number)
    return is_on(lane, along, across, lane.margin), along


@inlined
def place_near(road: Road, body: Body, number: int) -> tuple[bool, float]:
    """`place_on` a lane or those linked to it."""
    if road.lanes[number].linked == 1:
        return place_on(road, body, number)
    for link in range(road.lanes[number].linked):
        found, along = place_on(road, body, road.linked[number, link])
        if found:
            return True, along + road.offsets[number, link]
    return False, 0.0


@borrowing
def find_places(road: Road, bodies: Bodies, number: int, on_lane: OnLane) -> None:
    """Write the bodies that Road.neighbour_vehicles finds on a lane into `on_lane`, in their order."""
    lane, found = road.lanes[number], 0
    if lane.kind == STRAIGHT and lane.linked == 1:
        # The same without branches, which here cannot be predicted.
        start_x, start_y, direction_x, direction_y = lane.start_x, lane.start_y, lane.direction_x, lane.direction_y
        reach, end = lane.width / 2 + lane.margin, lane.length + CAR_LENGTH
        for other in range(bodies.size):
            off_x, off_y = bodies[other].x - start_x, bodies[other].y - start_y
            along = off_x * direction_x + off_y * direction_y
            across = off_x * -direction_y + off_y * direction_x
            there = (abs(across) <= reach) & (along >= -CAR_LENGTH) & (along < end)
            on_lane[1 + found].body, on_lane[1 + found].along = other, along
            found += there
    else:
        for other in range(bodies.size):
            there, along = place_near(road, bodies[other], number)
            if there:
                on_lane[1 + found].body, on_lane[1 + found].along = other, along
                found += 1
    on_lane[0].body = found


@inner
def new_places(lanes: int, bodies: int) -> Places:
    """A work array for the bodies on each lane."""
    return np.empty((lanes, 1 + bodies), PLACE)


@inlined
def neighbours_in(on_lane: OnLane, number: int, own: float) -> tuple[int, int]:
    """The bodies ahead of and behind a car that is `own` m along the lane, or NO_ONE.

    Of bodies at the same place the last is ahead and the first behind, as in highway-env.
    """
    front = rear = NO_ONE
    nearest, last = np.inf, -np.inf
    for place in range(1, 1 + on_lane[0].body):
        other, along = on_lane[place].body, on_lane[place].along
        # What is not ahead is at inf: the next body waits only for the two lines below.
        ahead = along if (other != number) & (own <= along) else np.inf
        behind = along if (other != number) & (along < own) else -np.inf
        front, nearest = other if ahead <= nearest else front, min(ahead, nearest)
        rear, last = other if behind > last else rear, max(behind, last)
    if nearest == np.inf:
        front = NO_ONE
    return front, rear


@inlined
def neighbours(road: Road, bodies: Bodies, number: int, lane: int, places: Places) -> tuple[int, int]:
    """Road.neighbour_vehicles: the bodies ahead of and behind a car on a lane, or NO_ONE.

    All cars of a frame decide before one moves, so the places on a lane are found for the first that asks.
    """
    if places[lane][0].body == UNKNOWN:
        find_places(road, bodies, lane, places[lane])
    own, _ = coordinates_on(road, bodies[number], lane)
    return neighbours_in(places[lane], number, own)


@borrowing
def lane_distance(road: Road, body: Body, other: Body) -> float:
    """RoadObject.lane_distance_to in m, along the lane of `body`."""
    along, _ = coordinates_on(road, other, body.lane)
    return along - body.along


@borrowing
def desired_gap(body: Body, leader: Body, parameters: Parameters) -> float:
    """IDMVehicle.desired_gap in m; the difference of velocities is projected onto the car's direction."""
    cos, sin = body.cos_heading, body.sin_heading
    along = body.speed * cos - leader.speed * leader.cos_heading
    across = body.speed * sin - leader.speed * leader.sin_heading
    closing = along * cos + across * sin
    return parameters.jam_distance + body.speed * TIME_GAP + body.speed * closing / parameters.gap_scale


@borrowing
def free_acceleration(road: Road, body: Body, delta: float, parameters: Parameters) -> float:
    """IDMVehicle.acceleration on an empty road, in m/s2; a continuous ego has no target speed, so its target is 0."""
    target = 0.0 if body.kind == CONTINUOUS else body.target_speed
    limit = road.lanes[body.lane].speed_limit
    if not math.isnan(limit):
        target = clip(target, 0.0, limit)
    share = max(body.speed, 0.0) / abs(not_zero(target))
    return parameters.idm_acceleration * (1 - power(share, delta))


@borrowing
def interaction(road: Road, body: Body, leader: Body, parameters: Parameters) -> float:
    """The term that IDMVehicle.acceleration subtracts for the body ahead, in m/s2."""
    ratio = desired_gap(body, leader, parameters) / not_zero(lane_distance(road, body, leader))
    return parameters.idm_acceleration * (ratio * ratio)


@borrowing
def following(road: Road, bodies: Bodies, number: int, leader: int, free: float, parameters: Parameters) -> float:
    """IDMVehicle.acceleration behind `leader` (or NO_ONE), in m/s2, given its value `free` on an empty road."""
    if leader < 0:
        return free
    return free - interaction(road, bodies[number], bodies[leader], parameters)


@borrowing
def wants_lane(
    road: Road,
    bodies: Bodies,
    number: int,
    lane: int,
    free: float,
    own_leader: int,
    parameters: Parameters,
    places: Places,
) -> bool:
    """IDMVehicle.mobil: whether changing to `lane` pays and imposes no hard braking on the new follower; politeness is 0.

    The conditions are independent of each other. On the first road of its route a car changes only towards its first lane.
    """
    body = bodies[number]
    leader, follower = neighbours(road, bodies, number, lane, places)
    own = following(road, bodies, number, leader, free, parameters)
    wanted = -1
    if body.route >= 0 and road.routes[body.route, body.route_place] >= 0:
        wanted = road.route_lanes[body.route, body.route_place]
    if wanted >= 0:
        target = road.lanes[body.target_lane].number
        if np.sign(road.lanes[lane].number - target) != np.sign(wanted - target):
            return False
        if own < -LANE_CHANGE_MAX_BRAKING_IMPOSED:
            return False
    elif own - following(road, bodies, number, own_leader, free, parameters) < LANE_CHANGE_MIN_GAIN:
        return False
    if follower < 0 or bodies[follower].kind == OBSTACLE:
        return True
    imposed = free_acceleration(road, bodies[follower], body.delta, parameters)
    braking = imposed - interaction(road, bodies[follower], body, parameters)
    return not braking < -LANE_CHANGE_MAX_BRAKING_IMPOSED


@borrowing
def must_abort(road: Road, bodies: Bodies, number: int, cars: int, parameters: Parameters) -> bool:
    """Whether a car just ahead is already changing to the same lane (IDMVehicle.change_lane_policy)."""
    body = bodies[number]
    if road.lanes[body.lane].edge != road.lanes[body.target_lane].edge:
        return False
    for other in range(cars):
        rival = bodies[other]
        if other == number or rival.kind == CONTINUOUS:
            continue
        if rival.lane == body.target_lane or rival.target_lane != body.target_lane:
            continue
        if 0 < lane_distance(road, body, rival) < desired_gap(body, rival, parameters):
            return True
    return False


@borrowing
def choose_lane(
    road: Road, bodies: Bodies, number: int, free: float, leader: int, parameters: Parameters, places: Places
) -> None:
    """The second half of IDMVehicle.change_lane_policy: test left, then right; right overwrites left."""
    body = bodies[number]
    body.timer = 0.0
    if abs(body.speed) < 1:
        return
    own = road.lanes[body.lane]
    edge = road.edges[own.edge]
    for side in (-1, 1):
        if not 0 <= own.number + side < edge.lanes:
            continue
        lane = body.lane + side
        if is_reachable(road, body, lane) and wants_lane(road, bodies, number, lane, free, leader, parameters, places):
            body.target_lane = lane


@borrowing
def drive_idm(road: Road, bodies: Bodies, number: int, cars: int, parameters: Parameters, places: Places) -> None:
    """IDMVehicle.act: MOBIL for the lane, IDM for the acceleration (over both lanes during a change)."""
    body = bodies[number]
    if body.crashed:
        return
    follow_road(road, body)
    free = free_acceleration(road, body, body.delta, parameters)
    leader, _ = neighbours(road, bodies, number, body.lane, places)
    if body.changes_lanes:
        if body.lane != body.target_lane:
            if must_abort(road, bodies, number, cars, parameters):
                body.target_lane = body.lane
        elif body.timer > LANE_CHANGE_DELAY:
            choose_lane(road, bodies, number, free, leader, parameters, places)
    body.steering = clip(steering_control(road, body, body.target_lane), -MAX_STEERING, MAX_STEERING)
    acceleration = following(road, bodies, number, leader, free, parameters)
    if body.lane != body.target_lane:
        leader, _ = neighbours(road, bodies, number, body.target_lane, places)
        acceleration = min(acceleration, following(road, bodies, number, leader, free, parameters))
    body.acceleration = clip(acceleration, -MAX_ACCELERATION, MAX_ACCELERATION)


@borrowing
def act(road: Road, bodies: Bodies, cars: int, parameters: Parameters, places: Places) -> None:
    """Road.act: every car decides, in highway-env's order, because each uses the target lanes chosen before it.

    `places` is a work array of `new_places`.
    """
    for lane in range(road.lane_count):
        places[lane][0].body = UNKNOWN
    for number in range(cars):
        body = bodies[number]
        if body.kind == IDM:
            drive_idm(road, bodies, number, cars, parameters, places)
        elif body.kind == DISCRETE:
            follow_road(road, body)
            body.steering = steering_control(road, body, body.target_lane)
            body.acceleration = speed_control(body)
