"""The kinematics of a world's cars: published facts, by which a policy can predict the effect of its own actions."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cavbench.driving.way import Way


@dataclass(frozen=True, kw_only=True)
class CarFollowing:
    """How other cars keep their distance: the Intelligent Driver Model (Treiber, Hennecke and Helbing 2000).

    Args:
        acceleration, braking: comfortable ones, in m/s2.
        jam_distance: d_0 in m, between the centres of two cars.
        time_gap: T in s.
        free_share: 1 - (v / v_0)^delta of a car in traffic, the part of the acceleration that pulls it forward.
    """

    acceleration: float
    braking: float
    jam_distance: float
    time_gap: float
    free_share: float

    @property
    def scale(self) -> float:
        """2 sqrt(a b) in m/s2, the divisor in the desired gap d_0 + T v + v dv / (2 sqrt(a b))."""
        return 2 * math.sqrt(self.acceleration * self.braking)


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
        top_speed: no car drives faster, in m/s.
        start_speed: the ego's speed at the start, in m/s; it starts in the middle of a lane. None if it starts at any speed and
            anywhere on a lane, so that only its first measurement says where.
        speed_gain, heading_gain, lateral_gain: gains of the controllers, in 1/s.
        max_heading: largest heading of a lane change, in rad.
        max_steering: largest steering angle of the controllers, in rad.
        acceleration_limit: of the continuous action, in m/s2.
        steering_limit: of the continuous action, in rad.
        following: how other cars keep their distance.
        oncoming: whether cars may come towards the ego, on a lane that it may use.
        way: the way that all cars follow if the lanes bend; None if they are straight.
    """

    frames: int
    lane_width: float
    length: float
    width: float
    target_speeds: tuple[float, ...]
    top_speed: float
    start_speed: float | None
    speed_gain: float
    heading_gain: float
    lateral_gain: float
    max_heading: float
    max_steering: float
    acceleration_limit: float
    steering_limit: float
    following: CarFollowing
    oncoming: bool = False
    way: Way | None = None
