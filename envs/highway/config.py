"""The checked configuration of the highway environments. Both environments read only this."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, get_args

from cavbench.driving.features import ActionType, Driver, Features
from cavbench.driving.kinematics import CarFollowing
from cavbench.driving.sets import Traffic
from cavbench.driving.surroundings import USUAL, Surroundings
from cavbench.envs.highway.axes import AXES
from cavbench.scenarios import Cell

Preset = Literal["standard", "thesis", "wide"]

ACTIONS = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
"""Discrete actions by number, as in highway-env's DiscreteMetaAction (envs/common/action.py)."""

UNITS = ("m", "m", "m/s", "m/s")
FLOORS = (0.5, 0.2, 0.3, 0.2)
"""Resolution of the sensor, in `UNITS`."""
STANDARD_FEATURES = Features(
    names=("x", "y", "vx", "vy"),
    low=(-100.0, -20.0, -40.0, -20.0),
    high=(100.0, 20.0, 40.0, 20.0),
    units=UNITS,
    floors=FLOORS,
)
WIDE_FEATURES = replace(STANDARD_FEATURES, low=(-100.0, -32.0, -40.0, -20.0), high=(100.0, 32.0, 40.0, 20.0))
"""The standard ranges with room for eight lanes."""
THESIS_FEATURES = Features(
    names=("x", "y", "vx", "vy"),
    low=(-100.0, -100.0, 0.0, 0.0),
    high=(100.0, 100.0, 20.0, 20.0),
    units=UNITS,
    floors=FLOORS,
)
STANDARD_TARGET_SPEEDS = (10.0, 15.0, 20.0, 25.0, 30.0)
THESIS_TARGET_SPEEDS = (20.0, 25.0, 30.0)

KINEMATICS: Mapping[str, Any] = {
    "lane_width": 4.0,
    "length": 5.0,
    "width": 2.0,
    "top_speed": 40.0,
    "start_speed": 25.0,
    "speed_gain": 1 / 0.6,
    "heading_gain": 1 / 0.2,
    "lateral_gain": 1 / 0.6,
    "max_heading": math.pi / 4,
    "max_steering": math.pi / 3,
    "acceleration_limit": 5.0,
    "steering_limit": math.pi / 4,
    "following": CarFollowing(acceleration=3.0, braking=5.0, jam_distance=10.0, time_gap=1.5, free_share=0.5),
}
"""highway-env's constants, as `cavbench.driving.Kinematics` names them. In flowing traffic half the IDM's free term is left."""


@dataclass(frozen=True, kw_only=True)
class HighwayConfig:
    """The configuration of highway-env's `highway-v0` on a straight road.

    Args:
        cells: lanes, density and weather of each episode of the batch (at least one).
        vehicles: number of traffic vehicles besides the ego, at least 1.
        ego_spacing: highway-env's spacing factor in front of the ego at the start.
        simulation_frequency: physics frames per second.
        policy_frequency: decisions per second; must divide `simulation_frequency`.
        max_steps: number of decisions until an episode is truncated.
        action_type: `discrete` lane-changing actions (`ACTIONS`), or `continuous` [acceleration, steering] in [-1, 1], mapped to
            -5 to 5 m/s2 and -45 to 45 degrees.
        driver: `agent` executes the actions; `idm` replaces the ego with highway-env's IDMVehicle and ignores them, `clairvoyant`
            drives it by plans that were tried in copies of the simulator.
        action_repeat: number of decisions for which an action is held: lane changes are sent once, then IDLE; other actions are
            repeated.
        target_speeds: increasing speeds in m/s for FASTER and SLOWER; highway-env assumes that they are uniform.
        features: observed features and the fixed ranges that map to [-1, 1].
        observed_vehicles: number of rows in an observation, including the ego; at least 2.
        lane_range: whether y ends at the width of the road, 4 m times its lanes, in place of the range in `features`: highway-env
            without a `features_range`.
        collision_reward, right_lane_reward, high_speed_reward: weights of highway-env's reward.
        reward_speed_range: speeds in m/s at which the speed reward is 0 and 1.
        normalize_reward: map the reward to [0, 1] like highway-env.
        offroad_terminal: whether leaving the road ends the episode.
        others_collide: whether the traffic crashes into itself; in `highway-fast-v0` only the ego collides.
        start_lane: number of the lane in which the ego starts; None to draw it.
        surroundings: how the traffic drives, and what the ego's body and the road do.
        traffic: bounds of the cars that are driven by orders; None if there are none.

    Raises:
        ValueError: if a value is not allowed; the message is one line with the allowed values.
    """

    cells: tuple[Cell, ...] = (AXES.cell(lanes=3, density=1.0),)
    vehicles: int = 20
    ego_spacing: float = 2.0
    simulation_frequency: int = 15
    policy_frequency: int = 15
    max_steps: int = 450
    action_type: ActionType = "discrete"
    driver: Driver = "agent"
    action_repeat: int = 1
    target_speeds: tuple[float, ...] = STANDARD_TARGET_SPEEDS
    features: Features = STANDARD_FEATURES
    observed_vehicles: int = 10
    lane_range: bool = False
    collision_reward: float = -1.0
    right_lane_reward: float = 0.1
    high_speed_reward: float = 0.4
    reward_speed_range: tuple[float, float] = (20.0, 30.0)
    normalize_reward: bool = True
    offroad_terminal: bool = True
    others_collide: bool = True
    start_lane: int | None = None
    surroundings: Surroundings = USUAL
    traffic: Traffic | None = None

    def __post_init__(self) -> None:
        _check_counts(self)
        _check_frequencies(self)
        if self.action_type not in get_args(ActionType):
            raise ValueError(f"action_type must be one of {', '.join(get_args(ActionType))}, got {self.action_type!r}")
        if self.driver not in get_args(Driver):
            raise ValueError(f"driver must be one of {', '.join(get_args(Driver))}, got {self.driver!r}")
        check_target_speeds(self.target_speeds)
        _check_features(self.features)
        _check_reward(self)

    @property
    def batch(self) -> int:
        """Number of episodes."""
        return len(self.cells)

    @property
    def substeps(self) -> int:
        """Physics frames per decision."""
        return self.simulation_frequency // self.policy_frequency

    def features_on(self, lanes: int) -> Features:
        """The features with their ranges on a road of so many lanes."""
        if not self.lane_range:
            return self.features
        width, place = KINEMATICS["lane_width"] * lanes, self.features.names.index("y")
        low, high = list(self.features.low), list(self.features.high)
        low[place], high[place] = -width, width
        return replace(self.features, low=tuple(low), high=tuple(high))

    @classmethod
    def thesis(cls, **changes: object) -> HighwayConfig:
        """The thesis' observation (x, y +-100 m, velocities 0 to 20 m/s, 5 rows) and target speeds (20, 25, 30)."""
        defaults: dict[str, object] = {
            "features": THESIS_FEATURES,
            "observed_vehicles": 5,
            "target_speeds": THESIS_TARGET_SPEEDS,
        }
        return cls(**(defaults | changes))  # type: ignore[arg-type]


def lanes_held(features: Features) -> int:
    """The largest number of lanes whose right edge the range of y holds: a car beyond it would not see that it left the road."""
    width, high = KINEMATICS["lane_width"], features.high[features.names.index("y")]
    return int((high - width / 2) // width) + 1


def check_target_speeds(speeds: Sequence[float]) -> None:
    """Raise ValueError unless there are at least two increasing speeds from 0 to 40 m/s."""
    increasing = all(slower < faster for slower, faster in pairwise(speeds))
    if len(speeds) < 2 or not increasing or not (speeds[0] >= 0 and speeds[-1] <= 40):
        listed = ", ".join(f"{speed:g}" for speed in speeds)
        raise ValueError(f"target_speeds must be at least two increasing speeds from 0 to 40 m/s, got ({listed})")


def _check_counts(config: HighwayConfig) -> None:
    if not config.cells:
        raise ValueError("cells must name at least one cell")
    if not 1 <= config.vehicles <= 1000:
        raise ValueError(f"vehicles must be between 1 and 1000, got {config.vehicles}")
    if not 0 < config.ego_spacing < math.inf:
        raise ValueError(f"ego_spacing must be positive, got {config.ego_spacing}")
    if not 2 <= config.observed_vehicles <= 1001:
        raise ValueError(
            f"observed_vehicles must be between 2 and 1001 (it counts the ego), got {config.observed_vehicles}"
        )
    if config.max_steps < 1:
        raise ValueError(f"max_steps must be at least 1, got {config.max_steps}")
    if config.start_lane is not None and not 0 <= config.start_lane < min(cell.lanes for cell in config.cells):
        fewest = min(cell.lanes for cell in config.cells)
        raise ValueError(
            f"start_lane must be a lane of every road, from 0 to {fewest - 1} on {fewest} lanes, got {config.start_lane}"
        )
    if config.action_repeat < 1:
        raise ValueError(f"action_repeat must be at least 1, got {config.action_repeat}")


def _check_frequencies(config: HighwayConfig) -> None:
    simulation, policy = config.simulation_frequency, config.policy_frequency
    for name, value in (("simulation_frequency", simulation), ("policy_frequency", policy)):
        if value != int(value) or value < 1:
            raise ValueError(f"{name} must be a whole number of at least 1 Hz, got {value}")
    if simulation % policy:
        raise ValueError(f"policy_frequency must divide simulation_frequency ({simulation}), got {policy}")


def _check_features(features: Features) -> None:
    if features.names != STANDARD_FEATURES.names:
        raise ValueError(f"features must be x, y, vx, vy, got {', '.join(features.names)}")
    for name, low, high in zip(features.names, features.low, features.high, strict=True):
        if not -math.inf < low < high < math.inf:
            raise ValueError(f"the range of {name} must be finite and increasing, got [{low:g}, {high:g}]")


def _check_reward(config: HighwayConfig) -> None:
    low, high = config.reward_speed_range
    if not -math.inf < low < high < math.inf:
        raise ValueError(f"reward_speed_range must be finite and increasing, got [{low:g}, {high:g}]")
    weights = (config.collision_reward, config.right_lane_reward, config.high_speed_reward)
    if not all(math.isfinite(weight) for weight in weights):
        raise ValueError(f"reward weights must be finite, got {weights}")
    if config.normalize_reward and weights[0] == weights[1] + weights[2]:
        raise ValueError("normalize_reward needs a collision_reward different from the sum of the other two weights")
