"""The constants of highway-env 1.12.1's vehicles, for as long as the reference environment computes.

They are attributes of classes that all tasks of a process share, and making a task may rewrite them: an intersection gives all
IDM drivers another jam distance, acceleration and braking (highway_env/envs/intersection_env.py, `_make_vehicles`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from highway_env.road.lane import StraightLane
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle

OF_VEHICLES: dict[str, Any] = {
    "LENGTH": 5.0,
    "WIDTH": 2.0,
    "DEFAULT_INITIAL_SPEEDS": [23, 25],
    "MAX_SPEED": 40.0,
    "MIN_SPEED": -40.0,
}
OF_CONTROLLED: dict[str, Any] = OF_VEHICLES | {
    "KP_A": 1 / 0.6,
    "KP_HEADING": 1 / 0.2,
    "KP_LATERAL": 1 / 0.6,
    "TAU_PURSUIT": 0.5 * 0.2,
    "MAX_STEERING_ANGLE": math.pi / 3,
    "DELTA_SPEED": 5,
}
OF_TRAFFIC: dict[str, Any] = OF_CONTROLLED | {
    "ACC_MAX": 6.0,
    "COMFORT_ACC_MAX": 3.0,
    "COMFORT_ACC_MIN": -5.0,
    "DISTANCE_WANTED": 10.0,
    "TIME_WANTED": 1.5,
    "DELTA": 4.0,
    "DELTA_RANGE": [3.5, 4.5],
    "POLITENESS": 0.0,
    "LANE_CHANGE_MIN_ACC_GAIN": 0.2,
    "LANE_CHANGE_MAX_BRAKING_IMPOSED": 2.0,
    "LANE_CHANGE_DELAY": 1.0,
}
CONSTANTS: Mapping[type, Mapping[str, Any]] = {
    StraightLane: {"DEFAULT_WIDTH": 4, "VEHICLE_LENGTH": 5},
    Vehicle: OF_VEHICLES,
    ControlledVehicle: OF_CONTROLLED,
    MDPVehicle: OF_CONTROLLED,
    IDMVehicle: OF_TRAFFIC,
}


@contextmanager
def own_constants() -> Iterator[None]:
    """The constants as highway-env ships them; afterwards they are what other tasks of this process made of them."""
    changed = [
        (owner, name, value, vars(owner).get(name, _ABSENT))
        for owner, constants in CONSTANTS.items()
        for name, value in constants.items()
        if getattr(owner, name) != value
    ]
    try:
        for owner, name, value, _ in changed:
            setattr(owner, name, value)
        yield
    finally:
        for owner, name, _, theirs in changed:
            delattr(owner, name) if theirs is _ABSENT else setattr(owner, name, theirs)


_ABSENT = object()
