"""Traffic: highway-env's IDM and MOBIL (vehicle/behavior.py) and its search for neighbours (road/road.py).

`order` lists the vehicles by position (ties: by number), so that neighbours are found by searching outwards.
"""

from __future__ import annotations

import math

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import (
    CONTINUOUS,
    DISCRETE,
    IDM,
    SPEED_LIMIT,
    clip,
    is_on_lane,
    is_reachable,
    not_zero,
    speed_control,
    steering_control,
)
from cavbench.envs.highway.state import Integers, Vehicle, Vehicles

MAX_ACCELERATION = 6.0
COMFORT_ACCELERATION = 3.0
COMFORT_BRAKING = -5.0
JAM_DISTANCE = 10.0
TIME_GAP = 1.5
GAP_SCALE = 2 * math.sqrt(-COMFORT_ACCELERATION * COMFORT_BRAKING)
LANE_CHANGE_DELAY = 1.0
LANE_CHANGE_MIN_GAIN = 0.2
LANE_CHANGE_MAX_BRAKING_IMPOSED = 2.0
NEIGHBOUR_MARGIN = 1.0
NO_ONE = -1


@inner
def sort_by_position(vehicles: Vehicles, order: Integers) -> None:
    """Sort `order` [N] in place, by insertion sort, because it is nearly sorted from the previous frame."""
    for place in range(1, order.size):
        moved = order[place]
        x = vehicles[moved].x
        slot = place - 1
        while slot >= 0 and (vehicles[order[slot]].x > x or (vehicles[order[slot]].x == x and order[slot] > moved)):
            order[slot + 1] = order[slot]
            slot -= 1
        order[slot + 1] = moved


@inner
def front_vehicle(vehicles: Vehicles, order: Integers, place: int, lane: int) -> int:
    """Road.neighbour_vehicles: the nearest vehicle on `lane`, level with or ahead of the vehicle at `place` of `order`.

    Returns its number, or NO_ONE. Among vehicles at the same position the last in highway-env's order is taken.
    """
    x = vehicles[order[place]].x
    first = place
    while first > 0 and vehicles[order[first - 1]].x == x:
        first -= 1
    found = NO_ONE
    for candidate in range(first, order.size):
        other = order[candidate]
        if found >= 0 and vehicles[other].x > vehicles[found].x:
            break
        if candidate != place and is_on_lane(vehicles[other], lane, NEIGHBOUR_MARGIN):
            found = other
    return found


@inner
def rear_vehicle(vehicles: Vehicles, order: Integers, place: int, lane: int) -> int:
    """Road.neighbour_vehicles: the nearest vehicle on `lane` behind the vehicle at `place` of `order`.

    Returns its number, or NO_ONE. Among vehicles at the same position the first in highway-env's order is taken.
    """
    x = vehicles[order[place]].x
    found = NO_ONE
    for candidate in range(place - 1, -1, -1):
        other = order[candidate]
        if found >= 0 and vehicles[other].x < vehicles[found].x:
            break
        if vehicles[other].x < x and is_on_lane(vehicles[other], lane, NEIGHBOUR_MARGIN):
            found = other
    return found


@inner
def desired_gap(vehicle: Vehicle, leader: Vehicle) -> float:
    """IDMVehicle.desired_gap in m; the difference of velocities is projected onto the vehicle's direction."""
    cos, sin = vehicle.cos_heading, vehicle.sin_heading
    along = vehicle.speed * cos - leader.speed * leader.cos_heading
    across = vehicle.speed * sin - leader.speed * leader.sin_heading
    closing = along * cos + across * sin
    return JAM_DISTANCE + vehicle.speed * TIME_GAP + vehicle.speed * closing / GAP_SCALE


@inner
def free_acceleration(vehicle: Vehicle, target_speed: float, delta: float) -> float:
    """IDMVehicle.acceleration on an empty road, in m/s2."""
    wanted = abs(not_zero(clip(target_speed, 0.0, SPEED_LIMIT)))
    return COMFORT_ACCELERATION * (1 - math.pow(max(vehicle.speed, 0.0) / wanted, delta))


@inner
def interaction(vehicle: Vehicle, leader: Vehicle) -> float:
    """The term that IDMVehicle.acceleration subtracts for the vehicle ahead, in m/s2."""
    ratio = desired_gap(vehicle, leader) / not_zero(leader.x - vehicle.x)
    return COMFORT_ACCELERATION * (ratio * ratio)


@inner
def following_acceleration(vehicles: Vehicles, number: int, leader: int, free: float) -> float:
    """IDMVehicle.acceleration behind `leader` (or NO_ONE), in m/s2, given its value `free` on an empty road."""
    if leader < 0:
        return free
    return free - interaction(vehicles[number], vehicles[leader])


@inner
def wants_lane(
    vehicles: Vehicles, order: Integers, place: int, lane: int, free: float, own_leader: int, ego: int
) -> bool:
    """IDMVehicle.mobil: whether changing to `lane` has a gain and imposes no hard braking on the new follower.

    The two conditions are independent; the cheap one is tested first. Politeness is 0 in highway-env. The follower's
    acceleration uses the deciding vehicle's IDM exponent; a continuous ego has no target speed, so its target is 0.
    """
    number = order[place]
    new_leader = front_vehicle(vehicles, order, place, lane)
    gain = following_acceleration(vehicles, number, new_leader, free) - following_acceleration(
        vehicles, number, own_leader, free
    )
    if gain < LANE_CHANGE_MIN_GAIN:
        return False
    follower = rear_vehicle(vehicles, order, place, lane)
    if follower < 0:
        return True
    target_speed = 0.0 if follower == 0 and ego == CONTINUOUS else vehicles[follower].target_speed
    imposed = free_acceleration(vehicles[follower], target_speed, vehicles[number].delta)
    return not imposed - interaction(vehicles[follower], vehicles[number]) < -LANE_CHANGE_MAX_BRAKING_IMPOSED


@inner
def must_abort(vehicles: Vehicles, number: int, ego: int) -> bool:
    """Whether a vehicle just ahead is already changing to the same lane (IDMVehicle.change_lane_policy)."""
    vehicle = vehicles[number]
    for other in range(1 if ego == CONTINUOUS else 0, vehicles.size):
        rival = vehicles[other]
        if rival.target_lane != vehicle.target_lane or rival.lane == vehicle.target_lane or other == number:
            continue
        distance = rival.x - vehicle.x
        if 0 < distance < desired_gap(vehicle, rival):
            return True
    return False


@inner
def choose_lane(
    vehicles: Vehicles, order: Integers, place: int, lanes: int, free: float, leader: int, ego: int
) -> None:
    """The second half of IDMVehicle.change_lane_policy: test left, then right; right overwrites left."""
    vehicle = vehicles[order[place]]
    vehicle.timer = 0.0
    if abs(vehicle.speed) < 1:
        return
    for lane in (vehicle.lane - 1, vehicle.lane + 1):
        if (
            0 <= lane < lanes
            and is_reachable(vehicle, lane)
            and wants_lane(vehicles, order, place, lane, free, leader, ego)
        ):
            vehicle.target_lane = lane


@inner
def drive_idm(vehicles: Vehicles, order: Integers, place: int, lanes: int, ego: int) -> None:
    """IDMVehicle.act: MOBIL for the lane, IDM for the acceleration (over both lanes during a change)."""
    number = order[place]
    vehicle = vehicles[number]
    if vehicle.crashed:
        return
    free = free_acceleration(vehicle, vehicle.target_speed, vehicle.delta)
    leader = front_vehicle(vehicles, order, place, vehicle.lane)
    if vehicle.lane != vehicle.target_lane:
        if must_abort(vehicles, number, ego):
            vehicle.target_lane = vehicle.lane
    elif vehicle.timer > LANE_CHANGE_DELAY:
        choose_lane(vehicles, order, place, lanes, free, leader, ego)
    vehicle.steering = steering_control(vehicle, vehicle.target_lane)
    acceleration = following_acceleration(vehicles, number, leader, free)
    if vehicle.lane != vehicle.target_lane:
        leader = front_vehicle(vehicles, order, place, vehicle.target_lane)
        acceleration = min(acceleration, following_acceleration(vehicles, number, leader, free))
    vehicle.acceleration = clip(acceleration, -MAX_ACCELERATION, MAX_ACCELERATION)


@inner
def act(vehicles: Vehicles, order: Integers, places: Integers, lanes: int, ego: int) -> None:
    """Road.act: every vehicle decides, in highway-env's order, because each uses the target lanes chosen before it.

    `places` [N] is a work array for the position of each vehicle in `order`.
    """
    for place in range(order.size):
        places[order[place]] = place
    if ego == DISCRETE:
        vehicles[0].steering = steering_control(vehicles[0], vehicles[0].target_lane)
        vehicles[0].acceleration = speed_control(vehicles[0])
    elif ego == IDM:
        drive_idm(vehicles, order, places[0], lanes, ego)
    for number in range(1, vehicles.size):
        drive_idm(vehicles, order, places[number], lanes, ego)
