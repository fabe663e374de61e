"""Cars that an attacker drives: orders in, bounds enforced (`cavbench.driving.sets.Traffic`)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, inner
from cavbench.envs.highway.dynamics import (
    LANE_WIDTH,
    MAX_STEERING,
    VEHICLE_LENGTH,
    VEHICLE_WIDTH,
    clip,
    closest_lane,
    steer_to,
)
from cavbench.envs.highway.state import Bounds, Floats, Integers, Vehicle, Vehicles

GENTLE = 2.0
"""Braking up to this, in m/s2, is no manoeuvre: every car may do it at any time."""
SIDE_MARGIN = 0.3
"""Cars are beside each other if less than their width and this, in m, is between their centres."""
SAME_PLACE = 0.01
"""An order to steer to another place across the road by less than this, in m, changes nothing."""
STANDSTILL = 2.0
"""Braking fades below so many m/s2 per m/s, so that a driven car stops and does not reverse."""
RESERVE = 1.0
"""A driven car keeps the room to brake behind the car ahead, and this in m."""
BRAKES = 6.0
"""So hard, in m/s2, the car ahead of a driven one is assumed to brake."""
TAKEN, MOVED, BRAKED, REFUSED = range(4)
"""What came of the orders of an episode: cars taken, changes of place and hard brakings begun, manoeuvres and cars refused."""
COUNTS = 4


@inner
def is_beside(y: float, other: Vehicle) -> bool:
    """Whether a car at the place `y` across the road is in the way of another one."""
    return abs(other.y - y) < VEHICLE_WIDTH + SIDE_MARGIN


@inner
def has_room(rear: Vehicle, front: Vehicle, bounds: Bounds) -> bool:
    """Whether a manoeuvre that concerns these two may begin."""
    gap = front.x - rear.x - VEHICLE_LENGTH
    return gap >= bounds.gap + bounds.headway * max(rear.speed, 0.0) and rear.speed - front.speed <= bounds.closing


@inner
def may_move(vehicles: Vehicles, number: int, y: float, bounds: Bounds) -> bool:
    """Whether the car may begin to steer to the place `y` across the road: room to every car that it would come in front of."""
    car = vehicles[number]
    for other in range(vehicles.size):
        # Cars in the same track now are ahead or behind already.
        same_track = abs(vehicles[other].y - car.y) < VEHICLE_WIDTH
        if other == number or same_track or not is_beside(y, vehicles[other]):
            continue
        ahead = vehicles[other].x >= car.x
        if not has_room(vehicles[number if ahead else other], vehicles[other if ahead else number], bounds):
            return False
    return True


@inner
def may_brake(vehicles: Vehicles, number: int, bounds: Bounds) -> bool:
    """Whether the car may begin to brake hard: room to every car behind it."""
    car = vehicles[number]
    for other in range(vehicles.size):
        behind = other != number and vehicles[other].x < car.x and is_beside(car.y, vehicles[other])
        if behind and not has_room(vehicles[other], car, bounds):
            return False
    return True


@inner
def obey(
    vehicles: Vehicles, number: int, acceleration: float, y: float, lanes: int, bounds: Bounds, counts: Integers
) -> None:
    """Take the order to a driven car for the next decision, within the bounds; `counts` [4] as in the columns above."""
    car = vehicles[number]
    place = clip(y, 0.0, LANE_WIDTH * (lanes - 1))
    if abs(place - car.ordered_y) > SAME_PLACE:
        if may_move(vehicles, number, place, bounds):
            counts[MOVED] += 1
            car.ordered_y = place
            car.target_lane = closest_lane(car.x, place, 0.0, lanes)
        else:
            counts[REFUSED] += 1
    wanted = clip(acceleration, -bounds.braking, bounds.acceleration)
    if wanted >= -GENTLE:
        car.braking = False
    elif not car.braking:
        if may_brake(vehicles, number, bounds):
            counts[BRAKED] += 1
            car.braking = True
        else:
            counts[REFUSED] += 1
            wanted = -GENTLE
    car.ordered_acceleration = wanted


@inner
def take_orders(vehicles: Vehicles, orders: Floats, lanes: int, bounds: Bounds, counts: Integers) -> None:
    """Release the cars without an order, take those with one, and take the orders [N, 3] of one episode."""
    driven = 0
    for number in range(1, vehicles.size):
        car = vehicles[number]
        car.ordered = car.ordered and orders[number, 0] > 0 and not car.crashed
        driven += 1 if car.ordered else 0
    for number in range(1, vehicles.size):
        car = vehicles[number]
        if not orders[number, 0] > 0 or car.crashed:
            continue
        if not car.ordered:
            if driven >= bounds.cars:
                counts[REFUSED] += 1
                continue
            driven += 1
            counts[TAKEN] += 1
            car.ordered, car.braking = True, False
            car.ordered_y = LANE_WIDTH * car.target_lane
        obey(vehicles, number, orders[number, 1], orders[number, 2], lanes, bounds, counts)


@inner
def braking_distance(speed: float, braking: float) -> float:
    """m that a car needs to stop."""
    return speed * speed / (2 * braking) if speed > 0 else 0.0


@inner
def kept_slow(car: Vehicle, steering: float, lateral_speed: float) -> float:
    """The steering angle in rad nearest to `steering` with which the car moves across the road no faster than it may, in m/s."""
    course = math.asin(min(lateral_speed / max(car.speed, 0.01), 1.0))
    slip = clip(math.atan(0.5 * math.tan(steering)), -course - car.heading, course - car.heading)
    return clip(math.atan(2 * math.tan(clip(slip, -1.0, 1.0))), -MAX_STEERING, MAX_STEERING)


@inner
def follow_orders(vehicles: Vehicles, order: Integers, place: int, bounds: Bounds) -> None:
    """Road.act for a car that is driven by orders: its last order, but it does not run into the car ahead."""
    car = vehicles[order[place]]
    if car.crashed:
        return
    wanted = car.ordered_acceleration
    for ahead in range(place + 1, order.size):
        other = vehicles[order[ahead]]
        if is_beside(car.y, other) or is_beside(car.ordered_y, other):
            gap = other.x - car.x - VEHICLE_LENGTH - RESERVE
            if gap < braking_distance(car.speed, bounds.braking) - braking_distance(other.speed, BRAKES):
                wanted = -bounds.braking
            break
    car.acceleration = max(wanted, -STANDSTILL * max(car.speed, 0.0))
    car.steering = kept_slow(car, steer_to(car, car.ordered_y, bounds.lateral_speed), bounds.lateral_speed)


@entry_point
def order_batch(
    vehicles: NDArray[np.void],
    episodes: NDArray[np.void],
    orders: Floats,
    paused: NDArray[np.bool_],
    bounds: Bounds,
    counts: Integers,
) -> None:
    """Take the orders [B, N, 3] (driven, acceleration, y) of every unfinished episode. See `HighwayEngine.order_cars`."""
    for number in range(episodes.size):
        episode = episodes[number]
        if paused[number] or episode.terminated or episode.truncated:
            continue
        take_orders(vehicles[number], orders[number], episode.lanes, bounds, counts[number])
