"""Traffic: highway-env's IDM and MOBIL (vehicle/behavior.py)."""

from __future__ import annotations

import math

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import (
    CONTINUOUS,
    DISCRETE,
    IDM,
    SPEED_LIMIT,
    clip,
    is_reachable,
    not_zero,
    speed_control,
    steering_control,
    weigh,
)
from cavbench.envs.highway.ordered import follow_orders
from cavbench.envs.highway.search import front_vehicle, rear_vehicle
from cavbench.envs.highway.state import Integers, Manners, Parameters, Vehicle, Vehicles

MAX_ACCELERATION = 6.0
LANE_CHANGE_DELAY = 1.0


@inner
def desired_gap(vehicle: Vehicle, leader: Vehicle, manners: Manners) -> float:
    """IDMVehicle.desired_gap in m; the difference of velocities is projected onto the vehicle's direction."""
    cos, sin = vehicle.cos_heading, vehicle.sin_heading
    along = vehicle.speed * cos - leader.speed * leader.cos_heading
    across = vehicle.speed * sin - leader.speed * leader.sin_heading
    closing = along * cos + across * sin
    return manners.jam_distance + vehicle.speed * manners.time_gap + vehicle.speed * closing / manners.gap_scale


@inner
def free_acceleration(vehicle: Vehicle, target_speed: float, delta: float, manners: Manners) -> float:
    """IDMVehicle.acceleration on an empty road, in m/s2."""
    wanted = abs(not_zero(clip(target_speed, 0.0, SPEED_LIMIT)))
    return manners.acceleration * (1 - math.pow(max(vehicle.speed, 0.0) / wanted, delta))


@inner
def interaction(vehicle: Vehicle, leader: Vehicle, manners: Manners) -> float:
    """The term that IDMVehicle.acceleration subtracts for the vehicle ahead, in m/s2."""
    ratio = desired_gap(vehicle, leader, manners) / not_zero(leader.x - vehicle.x)
    return manners.acceleration * (ratio * ratio)


@inner
def following_acceleration(vehicles: Vehicles, number: int, leader: int, free: float, manners: Manners) -> float:
    """IDMVehicle.acceleration behind `leader` (or NO_ONE), in m/s2, given its value `free` on an empty road."""
    if leader < 0:
        return free
    return free - interaction(vehicles[number], vehicles[leader], manners)


@inner
def follower_acceleration(
    vehicles: Vehicles, number: int, follower: int, leader: int, ego: int, manners: Manners
) -> float:
    """What the deciding vehicle thinks that `follower` accelerates behind `leader` (or NO_ONE), in m/s2; 0 without a follower."""
    if follower < 0:
        return 0.0
    target_speed = 0.0 if follower == 0 and ego == CONTINUOUS else vehicles[follower].target_speed
    free = free_acceleration(vehicles[follower], target_speed, vehicles[number].delta, manners)
    return following_acceleration(vehicles, follower, leader, free, manners)


@inner
def gain_of_others(
    vehicles: Vehicles,
    order: Integers,
    place: int,
    lane: int,
    new_leader: int,
    own_leader: int,
    ego: int,
    manners: Manners,
) -> float:
    """What the new and the old follower gain by a change to `lane`, in m/s2: MOBIL weighs it with the politeness."""
    number = order[place]
    new, old = rear_vehicle(vehicles, order, place, lane), rear_vehicle(vehicles, order, place, vehicles[number].lane)
    return (
        follower_acceleration(vehicles, number, new, number, ego, manners)
        - follower_acceleration(vehicles, number, new, new_leader, ego, manners)
        + follower_acceleration(vehicles, number, old, own_leader, ego, manners)
        - follower_acceleration(vehicles, number, old, number, ego, manners)
    )


@inner
def wants_lane(
    vehicles: Vehicles, order: Integers, place: int, lane: int, free: float, own_leader: int, ego: int, manners: Manners
) -> bool:
    """IDMVehicle.mobil: whether changing to `lane` has a gain and imposes no hard braking on the new follower.

    The two conditions are independent; the cheap one is tested first. The followers' accelerations use the deciding vehicle's
    IDM exponent; a continuous ego has no target speed, so its target is 0.
    """
    number = order[place]
    new_leader = front_vehicle(vehicles, order, place, lane)
    gain = following_acceleration(vehicles, number, new_leader, free, manners) - following_acceleration(
        vehicles, number, own_leader, free, manners
    )
    if manners.politeness > 0:
        gain += manners.politeness * gain_of_others(vehicles, order, place, lane, new_leader, own_leader, ego, manners)
    if gain < manners.lane_gain:
        return False
    follower = rear_vehicle(vehicles, order, place, lane)
    if follower < 0:
        return True
    imposed = follower_acceleration(vehicles, number, follower, number, ego, manners)
    return not imposed < -manners.imposed_braking


@inner
def must_abort(vehicles: Vehicles, number: int, ego: int, manners: Manners) -> bool:
    """Whether a vehicle just ahead is already changing to the same lane (IDMVehicle.change_lane_policy)."""
    vehicle = vehicles[number]
    for other in range(1 if ego == CONTINUOUS else 0, vehicles.size):
        rival = vehicles[other]
        if rival.target_lane != vehicle.target_lane or rival.lane == vehicle.target_lane or other == number:
            continue
        distance = rival.x - vehicle.x
        if 0 < distance < desired_gap(vehicle, rival, manners):
            return True
    return False


@inner
def choose_lane(
    vehicles: Vehicles,
    order: Integers,
    place: int,
    lanes: int,
    free: float,
    leader: int,
    ego: int,
    manners: Manners,
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
            and wants_lane(vehicles, order, place, lane, free, leader, ego, manners)
        ):
            vehicle.target_lane = lane


@inner
def drive_idm(vehicles: Vehicles, order: Integers, place: int, lanes: int, ego: int, manners: Manners) -> None:
    """IDMVehicle.act: MOBIL for the lane, IDM for the acceleration (over both lanes during a change)."""
    number = order[place]
    vehicle = vehicles[number]
    if vehicle.crashed:
        return
    if manners.hold > 1:
        vehicle.held -= 1
        if vehicle.held > 0:
            vehicle.steering = steering_control(vehicle, vehicle.target_lane)
            return
        vehicle.held = manners.hold
    free = free_acceleration(vehicle, vehicle.target_speed, vehicle.delta, manners)
    leader = front_vehicle(vehicles, order, place, vehicle.lane)
    if vehicle.lane != vehicle.target_lane:
        if must_abort(vehicles, number, ego, manners):
            vehicle.target_lane = vehicle.lane
    elif vehicle.timer > LANE_CHANGE_DELAY:
        choose_lane(vehicles, order, place, lanes, free, leader, ego, manners)
    vehicle.steering = steering_control(vehicle, vehicle.target_lane)
    acceleration = following_acceleration(vehicles, number, leader, free, manners)
    if vehicle.lane != vehicle.target_lane:
        leader = front_vehicle(vehicles, order, place, vehicle.target_lane)
        acceleration = min(acceleration, following_acceleration(vehicles, number, leader, free, manners))
    vehicle.acceleration = clip(acceleration, -MAX_ACCELERATION, MAX_ACCELERATION)


@inner
def act(vehicles: Vehicles, order: Integers, places: Integers, lanes: int, parameters: Parameters) -> None:
    """Road.act: every vehicle decides, in highway-env's order, because each uses the target lanes chosen before it.

    `places` [N] is a work array for the position of each vehicle in `order`.
    """
    ego = parameters.ego
    for place in range(order.size):
        places[order[place]] = place
    if ego == DISCRETE:
        vehicles[0].steering = steering_control(vehicles[0], vehicles[0].target_lane)
        vehicles[0].acceleration = speed_control(vehicles[0])
        weigh(vehicles[0], parameters.mass, parameters.grip)
    elif ego == IDM:
        drive_idm(vehicles, order, places[0], lanes, ego, parameters.usual)
        weigh(vehicles[0], parameters.mass, parameters.grip)
    for number in range(1, vehicles.size):
        if vehicles[number].ordered:
            follow_orders(vehicles, order, places[number], parameters.bounds)
        else:
            drive_idm(vehicles, order, places[number], lanes, ego, parameters.manners)
