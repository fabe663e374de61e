"""Vehicle dynamics and lanes: highway-env's road/lane.py, vehicle/kinematics.py and vehicle/controller.py.

Floating-point operations are in the same order as in highway-env, so results are equal to the last bit. Shortcuts are used only
where they provably give the same bits (a vehicle that drives exactly along the road needs no trigonometry).
"""

from __future__ import annotations

import math

import numpy as np

from cavbench.compiled import inner
from cavbench.envs.highway.state import EgoKind, Vehicle

DISCRETE, CONTINUOUS, IDM = int(EgoKind.DISCRETE), int(EgoKind.CONTINUOUS), int(EgoKind.IDM)

LANE_WIDTH = 4.0
ROAD_LENGTH = 10_000.0
SPEED_LIMIT = 30.0
VEHICLE_LENGTH = 5.0
VEHICLE_WIDTH = 2.0
MAX_SPEED = 40.0

GAIN_SPEED = 1 / 0.6
GAIN_HEADING = 1 / 0.2
GAIN_LATERAL = 1 / 0.6
MAX_STEERING = np.pi / 3
MAX_LANE_CHANGE_HEADING = np.pi / 4
TWO_PI = 2 * np.pi


@inner
def clip(value: float, low: float, high: float) -> float:
    """`value` limited to [low, high]."""
    return min(max(value, low), high)


@inner
def linear_map(value: float, from_low: float, from_high: float, to_low: float, to_high: float) -> float:
    """highway_env.utils.lmap: map `value` from [from_low, from_high] to [to_low, to_high], without clipping."""
    return to_low + (value - from_low) * (to_high - to_low) / (from_high - from_low)


@inner
def not_zero(value: float) -> float:
    """highway_env.utils.not_zero: `value`, but at least 0.01 away from 0."""
    if abs(value) > 1e-2:
        return value
    return 1e-2 if value >= 0 else -1e-2


@inner
def wrap_to_pi(angle: float) -> float:
    """highway_env.utils.wrap_to_pi: `angle` in [-pi, pi)."""
    shifted = angle + np.pi
    if not 0.0 <= shifted < TWO_PI:
        shifted = shifted % TWO_PI
    return shifted - np.pi


@inner
def closest_lane(x: float, y: float, heading: float, lanes: int) -> int:
    """RoadNetwork.get_closest_lane_index; only the two lanes around `y` can be closest, and the lower one wins a tie."""
    angle = abs(wrap_to_pi(heading))
    before, beyond = max(x - ROAD_LENGTH, 0.0), max(0.0 - x, 0.0)
    below = int(clip(math.floor(y / LANE_WIDTH), 0.0, lanes - 1.0))
    above = int(clip(math.floor(y / LANE_WIDTH) + 1.0, 0.0, lanes - 1.0))
    distance_below = abs(y - LANE_WIDTH * below) + before + beyond + angle
    distance_above = abs(y - LANE_WIDTH * above) + before + beyond + angle
    return above if distance_above < distance_below else below


@inner
def is_on_lane(vehicle: Vehicle, lane: int, margin: float) -> bool:
    """AbstractLane.on_lane: whether the vehicle's centre is on the lane, widened by `margin` m on both sides."""
    near = abs(vehicle.y - LANE_WIDTH * lane) <= LANE_WIDTH / 2 + margin
    return near and -VEHICLE_LENGTH <= vehicle.x < ROAD_LENGTH + VEHICLE_LENGTH


@inner
def is_reachable(vehicle: Vehicle, lane: int) -> bool:
    """AbstractLane.is_reachable_from: whether a lane change to `lane` may start here."""
    near = abs(vehicle.y - LANE_WIDTH * lane) <= 2 * LANE_WIDTH
    return near and 0 <= vehicle.x < ROAD_LENGTH + VEHICLE_LENGTH


@inner
def update_direction(vehicle: Vehicle) -> None:
    """Update the stored cosine and sine of the heading."""
    if vehicle.heading == 0.0:
        vehicle.cos_heading = 1.0
        vehicle.sin_heading = 0.0
    else:
        vehicle.cos_heading = math.cos(vehicle.heading)
        vehicle.sin_heading = math.sin(vehicle.heading)


@inner
def steering_control(vehicle: Vehicle, lane: int) -> float:
    """ControlledVehicle.steering_control: the steering angle in rad that leads to the centre of `lane`."""
    return steer_to(vehicle, LANE_WIDTH * lane, math.inf)


@inner
def steer_to(vehicle: Vehicle, y: float, lateral_speed: float) -> float:
    """The steering angle in rad that leads to the place `y` across the road, at most at `lateral_speed` in m/s."""
    lateral = vehicle.y - y
    if lateral == 0.0 and vehicle.heading == 0.0:
        return 0.0
    speed = not_zero(vehicle.speed)
    heading_command = math.asin(clip(clip(-GAIN_LATERAL * lateral, -lateral_speed, lateral_speed) / speed, -1.0, 1.0))
    heading_reference = clip(heading_command, -MAX_LANE_CHANGE_HEADING, MAX_LANE_CHANGE_HEADING)
    heading_rate = GAIN_HEADING * wrap_to_pi(heading_reference - vehicle.heading)
    slip_angle = math.asin(clip(VEHICLE_LENGTH / 2 / speed * heading_rate, -1.0, 1.0))
    return clip(math.atan(2 * math.tan(slip_angle)), -MAX_STEERING, MAX_STEERING)


@inner
def speed_control(vehicle: Vehicle) -> float:
    """ControlledVehicle.speed_control: the acceleration in m/s2 towards the target speed."""
    return GAIN_SPEED * (vehicle.target_speed - vehicle.speed)


@inner
def weigh(ego: Vehicle, mass: float, grip: float) -> None:
    """What the ego's mass (over the nominal one) and the grip of the road (m/s2) leave of its commands."""
    if mass != 1.0:
        ego.acceleration /= mass
    if abs(ego.acceleration) > grip:
        ego.acceleration = clip(ego.acceleration, -grip, grip)
    # Turning costs v^2 sin(slip) / (L / 2), which is 0 when driving straight on.
    if ego.steering != 0.0 and grip < math.inf:
        steepest = VEHICLE_LENGTH / 2 * grip / max(ego.speed * ego.speed, 1.0)
        if steepest < 1.0:
            limit = math.atan(2 * math.tan(math.asin(steepest)))
            ego.steering = clip(ego.steering, -limit, limit)


@inner
def clip_actions(vehicle: Vehicle) -> None:
    """Vehicle.clip_actions: a crashed vehicle brakes to a stop, and no vehicle drives faster than 40 m/s."""
    if vehicle.crashed:
        vehicle.steering = 0.0
        vehicle.acceleration = -1.0 * vehicle.speed
    if vehicle.speed > MAX_SPEED:
        vehicle.acceleration = min(vehicle.acceleration, 1.0 * (MAX_SPEED - vehicle.speed))
    elif vehicle.speed < -MAX_SPEED:
        vehicle.acceleration = max(vehicle.acceleration, 1.0 * (-MAX_SPEED - vehicle.speed))


@inner
def move(vehicle: Vehicle, lanes: int, dt: float) -> None:
    """Vehicle.step and IDMVehicle.step: one frame of the kinematic bicycle model, then an update of the vehicle's lane."""
    vehicle.timer += dt
    clip_actions(vehicle)
    speed = vehicle.speed
    straight = vehicle.steering == 0.0 and vehicle.heading == 0.0
    if straight:
        vehicle.x += speed * dt
    else:
        slip = math.atan(0.5 * math.tan(vehicle.steering))
        vehicle.x += speed * math.cos(vehicle.heading + slip) * dt
        vehicle.y += speed * math.sin(vehicle.heading + slip) * dt
        vehicle.heading += speed * math.sin(slip) / (VEHICLE_LENGTH / 2) * dt
    if vehicle.impact_pair >= 0:
        vehicle.x += vehicle.impact_x
        vehicle.y += vehicle.impact_y
        vehicle.crashed = True
        vehicle.impact_pair = -1
    vehicle.speed += vehicle.acceleration * dt
    if not straight:
        update_direction(vehicle)
    vehicle.lane = closest_lane(vehicle.x, vehicle.y, vehicle.heading, lanes)
