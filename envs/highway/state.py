"""The engine's memory: one record a vehicle, one record an episode, and the parameters all episodes share.

Vehicles are kept in highway-env's order (the ego is 0), on which several of its rules depend.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.highway.config import HighwayConfig

VEHICLE = np.dtype(
    [
        ("x", np.float64),  # m along the road
        ("y", np.float64),  # m across it; lane i has its centre at 4 i
        ("heading", np.float64),  # rad
        ("speed", np.float64),  # m/s, signed
        ("cos_heading", np.float64),
        ("sin_heading", np.float64),
        ("target_speed", np.float64),  # m/s
        ("timer", np.float64),  # s since the last time a lane change was considered
        ("delta", np.float64),  # IDM exponent
        ("steering", np.float64),  # rad
        ("acceleration", np.float64),  # m/s2
        ("impact_x", np.float64),  # m, the push of a collision, applied in the next frame
        ("impact_y", np.float64),
        ("impact_pair", np.int64),  # the pair of vehicles that set the impact, -1 if none is pending
        ("lane", np.int64),
        ("target_lane", np.int64),
        ("crashed", np.bool_),
    ],
    align=True,
)

EPISODE = np.dtype(
    [
        ("lanes", np.int64),
        ("seed", np.int64),
        ("steps", np.int64),  # decisions so far
        ("sensor_range", np.float64),  # m
        ("noise_sigma", np.float64),  # m and m/s
        ("reward", np.float64),  # of the last step
        ("progress", np.float64),  # of the last step, in [0, 1] a decision
        ("ttc", np.float64),  # s
        ("crashed", np.bool_),
        ("offroad", np.bool_),
        ("terminated", np.bool_),
        ("truncated", np.bool_),
    ],
    align=True,
)


class EgoKind(IntEnum):
    """What the ego is: highway-env's MDPVehicle, its plain Vehicle, or its IDMVehicle."""

    DISCRETE = 0
    CONTINUOUS = 1
    IDM = 2


class Parameters(NamedTuple):
    """What all episodes of a batch share; see `HighwayConfig` for the meaning."""

    ego: int
    substeps: int
    dt: float
    max_steps: int
    action_repeat: int
    target_speeds: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    collision_reward: float
    right_lane_reward: float
    high_speed_reward: float
    reward_speed_low: float
    reward_speed_high: float
    normalize_reward: bool
    offroad_terminal: bool


def ego_kind(config: HighwayConfig) -> EgoKind:
    """The vehicle that stands for the ego under this configuration."""
    if config.driver == "idm":
        return EgoKind.IDM
    return EgoKind.DISCRETE if config.action_type == "discrete" else EgoKind.CONTINUOUS


def parameters(config: HighwayConfig) -> Parameters:
    """The configuration as the compiled engine reads it."""
    return Parameters(
        ego=int(ego_kind(config)),
        substeps=config.substeps,
        dt=1 / config.simulation_frequency,
        max_steps=config.max_steps,
        action_repeat=config.action_repeat,
        target_speeds=np.array(config.target_speeds, dtype=np.float64),
        low=np.array(config.features.low, dtype=np.float64),
        high=np.array(config.features.high, dtype=np.float64),
        collision_reward=float(config.collision_reward),
        right_lane_reward=float(config.right_lane_reward),
        high_speed_reward=float(config.high_speed_reward),
        reward_speed_low=float(config.reward_speed_range[0]),
        reward_speed_high=float(config.reward_speed_range[1]),
        normalize_reward=bool(config.normalize_reward),
        offroad_terminal=bool(config.offroad_terminal),
    )
