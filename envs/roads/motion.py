"""How a car moves: highway-env's vehicle/kinematics.py and vehicle/controller.py on a network of lanes.

Floating-point operations are in the same order as in highway-env. Shortcuts are used only where they give the same bits.
"""

from __future__ import annotations

import math

from cavbench.compiled import borrowing
from cavbench.envs.highway.dynamics import (
    GAIN_HEADING,
    GAIN_LATERAL,
    GAIN_SPEED,
    MAX_LANE_CHANGE_HEADING,
    MAX_SPEED,
    MAX_STEERING,
    clip,
    not_zero,
)
from cavbench.envs.highway.ego import FASTER, LANE_LEFT, LANE_RIGHT, SLOWER, nearest_target_speed
from cavbench.envs.roads.lanes import (
    coordinates_on,
    distance_to,
    heading_at,
    is_after_end,
    is_reachable,
    position,
    update_lane,
    wrap_to_pi,
)
from cavbench.envs.roads.network import LaneRecord
from cavbench.envs.roads.state import Body, Parameters, Road

PURSUIT = 0.5 * 0.2
"""ControlledVehicle.TAU_PURSUIT in s."""
SURELY_STEEP = 0.708
"""Above the sine of `MAX_LANE_CHANGE_HEADING`: such an angle is cut to that, whatever its last bits are."""
SURELY_FULL = 0.66
"""Above the sine of the slip angle at which the wheels turn by `MAX_STEERING`."""


@borrowing
def update_direction(body: Body) -> None:
    """Update the stored cosine and sine of the heading."""
    body.cos_heading = math.cos(body.heading)
    body.sin_heading = math.sin(body.heading)


@borrowing
def lane_onto(road: Road, lane: LaneRecord, edge: int, wanted: int, x: float, y: float) -> tuple[int, float]:
    """RoadNetwork.next_lane_given_next_road: the lane on a road that follows `lane`, and its distance in m from a point."""
    after = road.edges[edge]
    found = wanted
    if road.edges[lane.edge].lanes == after.lanes:
        if found < 0:
            found = lane.number
    else:
        least = math.inf
        for number in range(after.lanes):
            apart = distance_to(road.lanes[after.first + number], x, y)
            if apart < least:
                found, least = number, apart
    return after.first + found, distance_to(road.lanes[after.first + found], x, y)


@borrowing
def next_lane(road: Road, body: Body, current: int) -> int:
    """RoadNetwork.next_lane: along the route, otherwise onto the closest lane; the lane itself at a dead end."""
    lane = road.lanes[current]
    node = road.edges[lane.edge].end
    edge = wanted = -1
    if body.route >= 0:
        if road.routes[body.route, body.route_place] == lane.edge:
            body.route_place += 1
        following = road.routes[body.route, body.route_place]
        if following >= 0 and road.edges[following].start == node:
            edge, wanted = following, road.route_lanes[body.route, body.route_place]
    along, _ = coordinates_on(road, body, current)
    x, y = position(lane, along, 0.0)
    if edge >= 0:
        return lane_onto(road, lane, edge, wanted, x, y)[0]
    found, least = current, math.inf
    for candidate in range(road.edge_count):
        if road.edges[candidate].start == node:
            number, apart = lane_onto(road, lane, candidate, -1, x, y)
            if apart < least:
                found, least = number, apart
    return found


@borrowing
def follow_road(road: Road, body: Body) -> None:
    """ControlledVehicle.follow_road: at the end of the target lane, aim for the next one."""
    if is_after_end(road, body, body.target_lane):
        body.target_lane = next_lane(road, body, body.target_lane)


@borrowing
def steering_control(road: Road, body: Body, lane: int) -> float:
    """ControlledVehicle.steering_control: the steering angle in rad that leads to the centre of a lane."""
    along, across = coordinates_on(road, body, lane)
    ahead = heading_at(road.lanes[lane], along + body.speed * PURSUIT)
    if across == 0.0 and ahead == body.heading:
        return 0.0
    speed = not_zero(body.speed)
    share = -GAIN_LATERAL * across / speed
    command = math.asin(share) if abs(share) < SURELY_STEEP else math.copysign(1.0, share)
    heading_reference = ahead + clip(command, -MAX_LANE_CHANGE_HEADING, MAX_LANE_CHANGE_HEADING)
    heading_rate = GAIN_HEADING * wrap_to_pi(heading_reference - body.heading)
    slip = 5.0 / 2 / speed * heading_rate
    if slip == 0.0:
        return slip
    if abs(slip) > SURELY_FULL:
        return math.copysign(MAX_STEERING, slip)
    return clip(math.atan(2 * math.tan(math.asin(slip))), -MAX_STEERING, MAX_STEERING)


@borrowing
def speed_control(body: Body) -> float:
    """ControlledVehicle.speed_control: the acceleration in m/s2 towards the target speed."""
    return GAIN_SPEED * (body.target_speed - body.speed)


@borrowing
def shift_lane(road: Road, body: Body, change: int) -> None:
    """ControlledVehicle.act: aim for the lane to the left (-1) or right (1) of the target lane, if it can be reached."""
    lane = road.lanes[body.target_lane]
    edge = road.edges[lane.edge]
    wanted = edge.first + min(max(lane.number + change, 0), edge.lanes - 1)
    if is_reachable(road, body, wanted):
        body.target_lane = wanted


@borrowing
def apply_meta_action(road: Road, body: Body, action: int, parameters: Parameters) -> None:
    """MDPVehicle.act: change the target speed or the target lane."""
    if action in (FASTER, SLOWER):
        change = 1 if action == FASTER else -1
        index = nearest_target_speed(body.speed, parameters.target_speeds[: parameters.speeds]) + change
        body.speed_index = min(max(index, 0), parameters.speeds - 1)
        body.target_speed = parameters.target_speeds[body.speed_index]
    follow_road(road, body)
    if action in (LANE_LEFT, LANE_RIGHT):
        shift_lane(road, body, 1 if action == LANE_RIGHT else -1)


@borrowing
def clip_actions(body: Body) -> None:
    """Vehicle.clip_actions: a crashed car brakes to a stop, and no car drives faster than 40 m/s."""
    if body.crashed:
        body.steering = 0.0
        body.acceleration = -1.0 * body.speed
    if body.speed > MAX_SPEED:
        body.acceleration = min(body.acceleration, 1.0 * (MAX_SPEED - body.speed))
    elif body.speed < -MAX_SPEED:
        body.acceleration = max(body.acceleration, 1.0 * (-MAX_SPEED - body.speed))


@borrowing
def move(road: Road, body: Body, dt: float) -> None:
    """Vehicle.step and IDMVehicle.step: one frame of the kinematic bicycle model, then an update of the car's lane."""
    body.timer += dt
    clip_actions(body)
    speed = body.speed
    if body.steering == 0.0:
        body.x += speed * body.cos_heading * dt
        body.y += speed * body.sin_heading * dt
    else:
        slip = math.atan(0.5 * math.tan(body.steering))
        body.x += speed * math.cos(body.heading + slip) * dt
        body.y += speed * math.sin(body.heading + slip) * dt
        body.heading += speed * math.sin(slip) / (5.0 / 2) * dt
        update_direction(body)
    if body.impact:
        body.x += body.impact_x
        body.y += body.impact_y
        body.crashed = True
        body.impact = False
    body.speed += body.acceleration * dt
    update_lane(body, road)
