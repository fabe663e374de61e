"""The kinematics of a world's cars: published facts, by which a policy can predict the effect of its own actions."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Kinematics:
    """A kinematic bicycle model on parallel lanes, with highway-env's cascaded controllers for discrete actions.

    Lane i has its centre at `i * lane_width` m. Discrete actions are LANE_LEFT, IDLE, LANE_RIGHT, FASTER and SLOWER:
    highway-env's MDPVehicle and ControlledVehicle (vehicle/controller.py), whose gains these are. Continuous actions are
    acceleration and steering as shares of `acceleration_limit` and `steering_limit`.

    Args:
        frames: physics frames per decision.
        lane_width, length, width: of a lane and of a car, in m.
        target_speeds: speeds of FASTER and SLOWER in m/s, increasing and uniform.
        start_speed: the ego's speed at the start, in m/s; it starts in the middle of a lane.
        speed_gain, heading_gain, lateral_gain: gains of the controllers, in 1/s.
        max_heading: largest heading of a lane change, in rad.
        max_steering: largest steering angle of the controllers, in rad.
        acceleration_limit: of the continuous action, in m/s2.
        steering_limit: of the continuous action, in rad.
    """

    frames: int
    lane_width: float
    length: float
    width: float
    target_speeds: tuple[float, ...]
    start_speed: float
    speed_gain: float
    heading_gain: float
    lateral_gain: float
    max_heading: float
    max_steering: float
    acceleration_limit: float
    steering_limit: float
