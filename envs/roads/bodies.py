"""How bodies are put on the road at the start."""

from __future__ import annotations

import numpy as np

from cavbench.compiled import inner
from cavbench.envs.highway.ego import nearest_target_speed
from cavbench.envs.roads.lanes import update_lane
from cavbench.envs.roads.motion import update_direction
from cavbench.envs.roads.state import Bodies, Body, Kind, Parameters, Road

DISCRETE, OBSTACLE = int(Kind.DISCRETE), int(Kind.OBSTACLE)
DEFAULT_DELTA = 4.0
"""IDMVehicle.DELTA, the exponent of its free acceleration."""


@inner
def put_body(road: Road, body: Body, kind: int, x: float, y: float, heading: float, speed: float) -> None:
    """The constructors of highway-env's vehicles: on the closest lane, which is also the target, at the target speed."""
    body.kind = kind
    body.x, body.y, body.heading, body.speed = x, y, heading, speed
    body.length, body.width = 5.0, 2.0
    update_direction(body)
    body.lane = 0
    update_lane(body, road)
    body.target_lane = body.lane
    body.target_speed, body.speed_index = speed, 0
    body.timer = ((x + y) * np.pi) % 1.0
    body.delta = DEFAULT_DELTA
    body.steering = body.acceleration = 0.0
    body.impact_x = body.impact_y = 0.0
    body.impact = body.crashed = False
    body.changes_lanes, body.yielding = True, False
    body.slides, body.lateral_speed, body.yaw_rate = False, 0.0, 0.0
    body.route, body.route_place = -1, 0


@inner
def is_free(bodies: Bodies, cars: int, x: float, y: float, room: float) -> bool:
    """Whether no car is within `room` m of a point."""
    free = True
    for number in range(cars):
        off_x, off_y = bodies[number].x - x, bodies[number].y - y
        free &= off_x * off_x + off_y * off_y >= room * room
    return free


@inner
def put_obstacle(road: Road, body: Body, x: float, y: float) -> None:
    """highway-env's Obstacle: a square of 2 m that stands."""
    put_body(road, body, OBSTACLE, x, y, 0.0, 0.0)
    body.length = 2.0


@inner
def settle_ego(body: Body, parameters: Parameters) -> None:
    """MDPVehicle's constructor: the target speed is the one of the table next to the speed."""
    if parameters.ego == DISCRETE:
        body.speed_index = nearest_target_speed(body.target_speed, parameters.target_speeds[: parameters.speeds])
        body.target_speed = parameters.target_speeds[body.speed_index]
