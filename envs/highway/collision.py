"""Collision detection: highway-env's vehicle/objects.py and the separating-axis test of its utils.py."""

from __future__ import annotations

import math

import numpy as np

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import VEHICLE_LENGTH, VEHICLE_WIDTH
from cavbench.envs.highway.state import Floats, Integers, Vehicle, Vehicles

DIAGONAL = math.sqrt(VEHICLE_LENGTH**2 + VEHICLE_WIDTH**2)
SURELY = 1e-6
"""Margin in m, larger than any rounding error: pairs farther apart need no exact test."""


@inner
def interval_distance(low_a: float, high_a: float, low_b: float, high_b: float) -> float:
    """utils.interval_distance: gap between two intervals, negative if they overlap."""
    return low_b - high_a if low_a < low_b else low_a - high_b


@inner
def fill_corners(vehicle: Vehicle, corners: Floats) -> None:
    """RoadObject.polygon: write the rectangle's corners [5, 2], the first one again at the end."""
    cos, sin = vehicle.cos_heading, vehicle.sin_heading
    for corner in range(5):
        along = -VEHICLE_LENGTH / 2 if corner % 4 < 2 else VEHICLE_LENGTH / 2
        across = -VEHICLE_WIDTH / 2 if corner % 4 in (0, 3) else VEHICLE_WIDTH / 2
        corners[corner, 0] = cos * along - sin * across + vehicle.x
        corners[corner, 1] = sin * along + cos * across + vehicle.y


@inner
def project(corners: Floats, normal_x: float, normal_y: float) -> tuple[float, float]:
    """utils.project_polygon: smallest and largest coordinate of the corners along a normal."""
    low, high = np.inf, -np.inf
    for corner in range(5):
        along = corners[corner, 0] * normal_x + corners[corner, 1] * normal_y
        low, high = min(low, along), max(high, along)
    return low, high


@inner
def centre(corners: Floats, axis: int) -> float:
    """Mean of the four corners along an axis, summed in numpy's order."""
    return (corners[0, axis] + corners[1, axis] + corners[2, axis] + corners[3, axis]) / 4


@inner
def polygons_intersect(
    corners_a: Floats, corners_b: Floats, displacement_x: float, displacement_y: float
) -> tuple[bool, bool, float, float]:
    """utils.are_polygons_intersecting.

    Returns:
        Whether they overlap now, whether they will overlap within the frame, and the push that separates them (x, y in m).
    """
    intersecting = will_intersect = True
    nearest, push_x, push_y = np.inf, 0.0, 0.0
    centre_x = centre(corners_a, 0) - centre(corners_b, 0)
    centre_y = centre(corners_a, 1) - centre(corners_b, 1)
    for polygon in (corners_a, corners_b):
        for corner in range(4):
            normal_x = -polygon[corner + 1, 1] + polygon[corner, 1]
            normal_y = polygon[corner + 1, 0] - polygon[corner, 0]
            length = math.sqrt(normal_x * normal_x + normal_y * normal_y)
            normal_x /= length
            normal_y /= length
            low_a, high_a = project(corners_a, normal_x, normal_y)
            low_b, high_b = project(corners_b, normal_x, normal_y)
            if interval_distance(low_a, high_a, low_b, high_b) > 0:
                intersecting = False
            approach = normal_x * displacement_x + normal_y * displacement_y
            if approach < 0:
                low_a += approach
            else:
                high_a += approach
            distance = interval_distance(low_a, high_a, low_b, high_b)
            if distance > 0:
                will_intersect = False
            if not intersecting and not will_intersect:
                return False, False, 0.0, 0.0
            if abs(distance) < nearest:
                nearest = abs(distance)
                side = 1.0 if centre_x * normal_x + centre_y * normal_y > 0 else -1.0
                push_x, push_y = side * normal_x, side * normal_y
    return intersecting, will_intersect, nearest * push_x, nearest * push_y


@inner
def pass_side_by_side(first: Vehicle, second: Vehicle, displacement_x: float, displacement_y: float) -> bool:
    """Whether a line along the first vehicle separates the two, now and within the frame.

    One separating line implies that `polygons_intersect` finds no overlap and no impact; this line is cheap to test.
    """
    normal_x, normal_y = -first.sin_heading, first.cos_heading
    apart = abs(normal_x * (second.x - first.x) + normal_y * (second.y - first.y))
    length_share = abs(normal_x * second.cos_heading + normal_y * second.sin_heading)
    width_share = abs(normal_y * second.cos_heading - normal_x * second.sin_heading)
    reach = (VEHICLE_WIDTH + VEHICLE_LENGTH * length_share + VEHICLE_WIDTH * width_share) / 2
    return apart > reach + abs(normal_x * displacement_x + normal_y * displacement_y) + SURELY


@inner
def set_impact(vehicle: Vehicle, pair: int, push_x: float, push_y: float) -> None:
    """Set the impact; highway-env uses the last pair of a frame, so pairs are ranked because they come in any order here."""
    if pair > vehicle.impact_pair:
        vehicle.impact_x = push_x
        vehicle.impact_y = push_y
        vehicle.impact_pair = pair


@inner
def collide(
    vehicles: Vehicles, first_number: int, second_number: int, dt: float, corners_a: Floats, corners_b: Floats
) -> None:
    """RoadObject.handle_collisions for one pair, `first_number` < `second_number`.

    The distance of the first check grows with the speed of the first vehicle only, as in highway-env.
    """
    first, second = vehicles[first_number], vehicles[second_number]
    x, y = second.x - first.x, second.y - first.y
    if math.sqrt(x * x + y * y) > (DIAGONAL + DIAGONAL) / 2 + first.speed * dt:
        return
    displacement_x = first.speed * first.cos_heading * dt - second.speed * second.cos_heading * dt
    displacement_y = first.speed * first.sin_heading * dt - second.speed * second.sin_heading * dt
    if pass_side_by_side(first, second, displacement_x, displacement_y):
        return
    fill_corners(first, corners_a)
    fill_corners(second, corners_b)
    now, soon, push_x, push_y = polygons_intersect(corners_a, corners_b, displacement_x, displacement_y)
    if soon:
        pair = first_number * vehicles.size + second_number
        set_impact(first, pair, push_x / 2, push_y / 2)
        set_impact(second, pair, -push_x / 2, -push_y / 2)
    if now:
        first.crashed = True
        second.crashed = True


@inner
def find_collisions(vehicles: Vehicles, order: Integers, dt: float, others: bool, corners: Floats) -> None:
    """The second half of Road.step: test every pair that is close enough along the road.

    Pairs without the ego are tested if `others` collide, too (RoadObject.check_collisions). `corners` [2, 5, 2] is a work array.
    """
    fastest = 0.0
    for number in range(vehicles.size):
        fastest = max(fastest, vehicles[number].speed)
    reach = DIAGONAL + fastest * dt + SURELY
    for place in range(order.size):
        number = order[place]
        limit = vehicles[number].x + reach
        for ahead in range(place + 1, order.size):
            other = order[ahead]
            if vehicles[other].x > limit:
                break
            if not others and number != 0 and other != 0:
                continue
            collide(vehicles, min(number, other), max(number, other), dt, corners[0], corners[1])
