"""Right of way at crossings: highway-env's road/regulation.py."""

from __future__ import annotations

import math

import numpy as np

from cavbench.compiled import inner
from cavbench.envs.roads.lanes import heading_at, position
from cavbench.envs.roads.motion import move
from cavbench.envs.roads.sliding import slide
from cavbench.envs.roads.state import Bodies, Body, Floats, Kind, Road

CONTINUOUS, IDM = int(Kind.CONTINUOUS), int(Kind.IDM)
STEP, TIMES = 0.25, 11
"""Seconds between predictions, and how many there are: up to 2.75 s."""
NEAR = 5.0
"""Only predicted centres so close in m may be a conflict."""
HALF_LENGTH, HALF_WIDTH = 1.5 * 5.0 / 2, 0.9 * 2.0 / 2
"""Half the sides in m of the rectangles that must meet."""


@inner
def predict(road: Road, body: Body, seconds: float) -> tuple[float, float, float]:
    """ControlledVehicle.predict_trajectory_constant_speed: place and heading on the car's route after some seconds."""
    along = body.along + body.speed * seconds
    number = body.lane
    if body.route >= 0 and road.routes[body.route, body.route_place] >= 0:
        place = body.route_place
        number = route_lane(road, body, place)
        while road.routes[body.route, place + 1] >= 0 and along > road.lanes[number].length:
            along -= road.lanes[number].length
            place += 1
            number = route_lane(road, body, place)
    x, y = position(road.lanes[number], along, 0.0)
    return x, y, heading_at(road.lanes[number], along)


@inner
def predict_steered(road: Road, body: Bodies, predicted: Floats) -> None:
    """Vehicle.predict_trajectory_constant_speed: [11, 3] places and headings of a car that keeps steering as it does.

    `body` is an array of the car alone, which is changed.
    """
    car = body[0]
    car.acceleration = 0.0
    for time in range(TIMES):
        if car.slides:
            slide(road, car, STEP)
        else:
            move(road, car, STEP)
        predicted[time, 0], predicted[time, 1], predicted[time, 2] = car.x, car.y, car.heading


@inner
def route_lane(road: Road, body: Body, place: int) -> int:
    """The lane on a road of the route: the one that it names, otherwise the one with the number of the car's lane."""
    edge, wanted = road.routes[body.route, place], road.route_lanes[body.route, place]
    return road.edges[edge].first + (wanted if wanted >= 0 else road.lanes[body.lane].number)


@inner
def has_corner_inside(x: float, y: float, heading: float, other_x: float, other_y: float, other_heading: float) -> bool:
    """utils.has_corner_inside: whether one of nine points of a rectangle is inside another one.

    highway-env turns the points by the heading of the other rectangle, where it should turn them back.
    """
    cos, sin = math.cos(heading), math.sin(heading)
    turn_cos, turn_sin = math.cos(other_heading), math.sin(other_heading)
    found = False
    for along in (-HALF_LENGTH, 0.0, HALF_LENGTH):
        for across in (-HALF_WIDTH, 0.0, HALF_WIDTH):
            point_x = cos * along - sin * across + x - other_x
            point_y = sin * along + cos * across + y - other_y
            turned_x, turned_y = turn_cos * point_x - turn_sin * point_y, turn_sin * point_x + turn_cos * point_y
            found |= abs(turned_x) <= HALF_LENGTH and abs(turned_y) <= HALF_WIDTH
    return found


@inner
def is_conflict_possible(first: Floats, second: Floats) -> bool:
    """RegulatedRoad.is_conflict_possible, from the predictions [11, 3] of two cars: x, y and heading."""
    for number in range(TIMES):
        x, y = second[number, 0] - first[number, 0], second[number, 1] - first[number, 1]
        if math.sqrt(x * x + y * y) > NEAR:
            continue
        first_x, first_y, first_heading = first[number]
        second_x, second_y, second_heading = second[number]
        if has_corner_inside(first_x, first_y, first_heading, second_x, second_y, second_heading):
            return True
        if has_corner_inside(second_x, second_y, second_heading, first_x, first_y, first_heading):
            return True
    return False


@inner
def yields(road: Road, first: Body, second: Body) -> bool:
    """RegulatedRoad.respect_priorities: whether the first car must wait; at the same priority the one behind waits."""
    own, other = road.lanes[first.lane].priority, road.lanes[second.lane].priority
    if own != other:
        return own < other
    x, y = second.x - first.x, second.y - first.y
    ahead = first.cos_heading * x + first.sin_heading * y
    return ahead > second.cos_heading * -x + second.sin_heading * -y


@inner
def enforce_rules(road: Road, bodies: Bodies, cars: int) -> None:
    """RegulatedRoad.enforce_road_rules: cars that waited drive on, and those that must wait get the target speed 0."""
    for number in range(cars):
        body = bodies[number]
        if body.yielding:
            body.target_speed = road.lanes[body.lane].speed_limit
            body.yielding = False
    predicted = np.empty((cars, TIMES, 3))
    for number in range(cars):
        if bodies[number].kind == CONTINUOUS:
            predict_steered(road, bodies[number : number + 1].copy(), predicted[number])
            continue
        for time in range(TIMES):
            predicted[number, time] = predict(road, bodies[number], STEP + time * STEP)
    for number in range(cars):
        for other in range(number + 1, cars):
            if not is_conflict_possible(predicted[number], predicted[other]):
                continue
            loser = bodies[number] if yields(road, bodies[number], bodies[other]) else bodies[other]
            if loser.kind == IDM:
                loser.target_speed = 0.0
                loser.yielding = True
