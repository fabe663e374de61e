"""The engine's state: one record per vehicle, one record per episode, and the parameters shared by all episodes.

Vehicles are in highway-env's order (the ego is 0), because several of its rules depend on the order.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cavbench.driving.sets import Traffic
from cavbench.driving.surroundings import USUAL, Surroundings
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.config import HighwayConfig


class Vehicle:
    """One vehicle."""

    x: float  # m along the road
    y: float  # m across it; lane i has its centre at 4 i
    heading: float  # rad
    speed: float  # m/s, signed
    cos_heading: float
    sin_heading: float
    target_speed: float  # m/s
    timer: float  # s since a lane change was last considered
    delta: float  # exponent of the IDM
    steering: float  # rad
    acceleration: float  # m/s2
    impact_x: float  # m, the push of a collision, applied in the next frame
    impact_y: float  # m
    impact_pair: int  # the pair of vehicles that set the impact, -1 if none is pending
    lane: int
    target_lane: int
    crashed: bool
    held: int  # frames until it decides again
    ordered: bool  # driven by orders (`cavbench.envs.highway.ordered`), not by IDM and MOBIL
    braking: bool  # in a braking manoeuvre
    ordered_acceleration: float  # m/s2
    ordered_y: float  # m, where it steers to


class Episode:
    """One episode."""

    lanes: int
    seed: int  # scenario seed
    steps: int  # decisions so far
    sensor_range: float  # m
    noise_sigma: float  # m and m/s
    reward: float  # of the last action
    progress: float  # of the last action, in [0, 1] per decision
    ttc: float  # s, time to collision
    crashed: bool
    offroad: bool
    terminated: bool
    truncated: bool


def record_type(kind: type) -> np.dtype[np.void]:
    """The numpy record type with the annotated fields of a class."""
    fields = {"float": np.float64, "int": np.int64, "bool": np.bool_}
    return np.dtype([(name, fields[annotation]) for name, annotation in kind.__annotations__.items()], align=True)


VEHICLE = record_type(Vehicle)
EPISODE = record_type(Episode)


class Vehicles(Protocol):
    """The vehicles [N] of an episode in compiled code: a numpy array of `VEHICLE`."""

    size: int

    def __getitem__(self, number: int) -> Vehicle: ...


class EgoKind(IntEnum):
    """The type of the ego: highway-env's MDPVehicle, Vehicle or IDMVehicle."""

    DISCRETE = 0
    CONTINUOUS = 1
    IDM = 2


class Manners(NamedTuple):
    """Parameters of IDM and MOBIL; documented in `cavbench.driving.Surroundings`."""

    acceleration: float
    jam_distance: float
    time_gap: float
    gap_scale: float  # 2 sqrt(a b)
    lane_gain: float
    imposed_braking: float
    politeness: float
    hold: int  # frames for which a decision is held; 0 and 1 decide in every frame


class Bounds(NamedTuple):
    """What cars that are driven by orders may do; documented in `cavbench.driving.sets.Traffic`."""

    cars: int
    acceleration: float
    braking: float
    lateral_speed: float
    gap: float
    headway: float
    closing: float


class Parameters(NamedTuple):
    """The parameters shared by all episodes of a batch; documented in `HighwayConfig`."""

    ego: int
    substeps: int
    dt: float
    max_steps: int
    action_repeat: int
    target_speeds: NDArray[np.float64]
    low: NDArray[np.float64]  # [lanes, feature]: the ranges on a road of so many lanes
    high: NDArray[np.float64]
    collision_reward: float
    right_lane_reward: float
    high_speed_reward: float
    reward_speed_low: float
    reward_speed_high: float
    normalize_reward: bool
    offroad_terminal: bool
    others_collide: bool
    start_lane: int  # -1 if it is drawn
    usual: Manners  # of an ego that is an IDM car
    manners: Manners  # of the traffic
    mass: float
    grip: float  # m/s2, the largest acceleration of the ego in any direction
    bounds: Bounds


GRAVITY = 9.81
Integers = NDArray[np.int64]
Floats = NDArray[np.float64]


def manners(surroundings: Surroundings, frequency: int) -> Manners:
    """The manners of the traffic, at so many physics frames a second."""
    return Manners(
        acceleration=float(surroundings.acceleration),
        jam_distance=float(surroundings.jam_distance),
        time_gap=float(surroundings.time_gap),
        gap_scale=2 * math.sqrt(surroundings.acceleration * surroundings.braking),
        lane_gain=float(surroundings.lane_gain),
        imposed_braking=float(surroundings.imposed_braking),
        politeness=float(surroundings.politeness),
        hold=round(surroundings.reaction * frequency),
    )


def bounds(traffic: Traffic | None) -> Bounds:
    """The bounds of cars that are driven by orders; none is, if they are None."""
    traffic = traffic or Traffic(cars=0)
    values = [float(getattr(traffic, name)) for name in Bounds._fields if name != "cars"]
    return Bounds(int(traffic.cars), *values)


def ego_kind(config: HighwayConfig) -> EgoKind:
    """The type of the ego for a configuration."""
    if config.driver == "idm":
        return EgoKind.IDM
    return EgoKind.DISCRETE if config.action_type == "discrete" else EgoKind.CONTINUOUS


def parameters(config: HighwayConfig) -> Parameters:
    """The configuration for the compiled engine."""
    ranges = [config.features_on(lanes) for lanes in range(int(AXES["lanes"].high) + 1)]
    return Parameters(
        ego=int(ego_kind(config)),
        substeps=config.substeps,
        dt=1 / config.simulation_frequency,
        max_steps=config.max_steps,
        action_repeat=config.action_repeat,
        target_speeds=np.array(config.target_speeds, dtype=np.float64),
        low=np.array([features.low for features in ranges], dtype=np.float64),
        high=np.array([features.high for features in ranges], dtype=np.float64),
        collision_reward=float(config.collision_reward),
        right_lane_reward=float(config.right_lane_reward),
        high_speed_reward=float(config.high_speed_reward),
        reward_speed_low=float(config.reward_speed_range[0]),
        reward_speed_high=float(config.reward_speed_range[1]),
        normalize_reward=bool(config.normalize_reward),
        offroad_terminal=bool(config.offroad_terminal),
        others_collide=bool(config.others_collide),
        start_lane=-1 if config.start_lane is None else config.start_lane,
        usual=manners(USUAL, config.simulation_frequency),
        manners=manners(config.surroundings, config.simulation_frequency),
        mass=float(config.surroundings.mass),
        grip=GRAVITY * config.surroundings.friction if config.surroundings.friction < 1 else math.inf,
        bounds=bounds(config.traffic),
    )
