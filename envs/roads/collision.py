"""Collisions between bodies of any size: highway-env's vehicle/objects.py."""

from __future__ import annotations

import math

from cavbench.compiled import borrowing
from cavbench.envs.highway.collision import SURELY, polygons_intersect
from cavbench.envs.roads.state import Bodies, Body, Floats, Kind

OBSTACLE = int(Kind.OBSTACLE)


@borrowing
def fill_corners(body: Body, corners: Floats) -> None:
    """RoadObject.polygon: write the rectangle's corners [5, 2], the first one again at the end."""
    cos, sin = body.cos_heading, body.sin_heading
    for corner in range(5):
        along = -body.length / 2 if corner % 4 < 2 else body.length / 2
        across = -body.width / 2 if corner % 4 in (0, 3) else body.width / 2
        corners[corner, 0] = cos * along - sin * across + body.x
        corners[corner, 1] = sin * along + cos * across + body.y


@borrowing
def pass_side_by_side(first: Body, second: Body, displacement_x: float, displacement_y: float) -> bool:
    """Whether a line along the first body separates the two, now and within the frame.

    One separating line implies that `polygons_intersect` finds no overlap and no impact; this line is cheap to test.
    """
    normal_x, normal_y = -first.sin_heading, first.cos_heading
    apart = abs(normal_x * (second.x - first.x) + normal_y * (second.y - first.y))
    length_share = abs(normal_x * second.cos_heading + normal_y * second.sin_heading)
    width_share = abs(normal_y * second.cos_heading - normal_x * second.sin_heading)
    reach = (first.width + second.length * length_share + second.width * width_share) / 2
    return apart > reach + abs(normal_x * displacement_x + normal_y * displacement_y) + SURELY


@borrowing
def set_impact(body: Body, push_x: float, push_y: float) -> None:
    """Set the impact; highway-env uses the last pair of a frame."""
    body.impact_x, body.impact_y, body.impact = push_x, push_y, True


@borrowing
def collide(first: Body, second: Body, dt: float, corners: Floats) -> None:
    """RoadObject.handle_collisions for one pair, the first before the second in the list of cars.

    The distance of the first check grows with the speed of the first only. A car takes the whole push of an obstacle.
    """
    x, y = second.x - first.x, second.y - first.y
    first_diagonal = math.sqrt(first.length * first.length + first.width * first.width)
    second_diagonal = math.sqrt(second.length * second.length + second.width * second.width)
    if math.sqrt(x * x + y * y) > (first_diagonal + second_diagonal) / 2 + first.speed * dt:
        return
    displacement_x = first.speed * first.cos_heading * dt - second.speed * second.cos_heading * dt
    displacement_y = first.speed * first.sin_heading * dt - second.speed * second.sin_heading * dt
    if pass_side_by_side(first, second, displacement_x, displacement_y):
        return
    fill_corners(first, corners[0])
    fill_corners(second, corners[1])
    now, soon, push_x, push_y = polygons_intersect(corners[0], corners[1], displacement_x, displacement_y)
    if soon:
        if second.kind == OBSTACLE:
            set_impact(first, push_x, push_y)
        else:
            set_impact(first, push_x / 2, push_y / 2)
            set_impact(second, -push_x / 2, -push_y / 2)
    if now:
        first.crashed = True
        second.crashed = True


@borrowing
def find_collisions(bodies: Bodies, cars: int, dt: float, corners: Floats) -> None:
    """The second half of Road.step: test every pair in highway-env's order. `corners` [2, 5, 2] is a work array."""
    for number in range(cars):
        first = bodies[number]
        reach = 6.0 + max(first.speed * dt, 0.0)
        for other in range(number + 1, bodies.size):
            second = bodies[other]
            if max(abs(second.x - first.x), abs(second.y - first.y)) < reach:
                collide(first, second, dt, corners)
