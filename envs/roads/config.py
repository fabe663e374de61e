"""The checked configuration of the engine of road networks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, get_args

import numpy as np
from numpy.typing import NDArray

from cavbench.driving.features import ActionType, Driver
from cavbench.envs.highway.config import check_target_speeds
from cavbench.envs.roads.recordings import NOTHING, Reaction, Recordings
from cavbench.envs.roads.state import MOST_COLUMNS, MOST_SPEEDS, PARAMETERS, Feature, Kind, Measure, ViewKind


class TaskKind(IntEnum):
    """Tasks by the rules of their start and reward."""

    MERGE_CLASSIC = 0
    MERGE_GENERIC = 1
    ROUNDABOUT = 2
    INTERSECTION = 3
    EXIT = 4
    TWO_WAY = 5
    U_TURN = 6
    RACETRACK = 7
    RECORDED = 8


DEFAULT_SPEEDS = (20.0, 25.0, 30.0)
"""MDPVehicle.DEFAULT_TARGET_SPEEDS in m/s."""


REGULATIONS = 2
"""RegulatedRoad.REGULATION_FREQUENCY in Hz."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """The road of an episode and its sensor.

    Args:
        road: the network, from `cavbench.envs.roads.network.record`.
        traffic: number of cars besides the ego, where the task lets it vary.
        capacity: the largest number of bodies: cars and obstacles.
        oncoming: number of cars on the opposite lane, where there is one.
        density, opposing: by what the distances between cars are divided at the start, here and on the opposite lane.
        arrivals: the chance that a car comes after a decision, where cars come.
        goal: number of the ego's destination among those of the road, where it has one.
        sensor_range: in m.
        noise_sigma: of the sensor, in m and m/s.
        recordings: recorded traffic; equal recordings must be the same object.
        reaction: what recorded cars do.
    """

    road: NDArray[np.void]
    traffic: int = 0
    capacity: int
    oncoming: int = 0
    density: float = 1.0
    opposing: float = 1.0
    arrivals: float = 0.0
    goal: int = 0
    sensor_range: float = 200.0
    noise_sigma: float = 0.0
    recordings: Recordings = NOTHING
    reaction: Reaction = Reaction.REPLAY


@dataclass(frozen=True, kw_only=True, eq=False)
class RoadsConfig:
    """The configuration of a batch of episodes of one task.

    Args:
        task: the rules of start and reward.
        scenes: road and sensor of each episode of the batch; episodes on the same road share the object.
        simulation_frequency: physics frames per second.
        policy_frequency: decisions per second. A decision has `simulation_frequency // policy_frequency` frames, as in
            highway-env, so that 15 and 10 Hz drive at two thirds of the speed.
        max_steps: number of decisions until an episode is truncated.
        duration: seconds until an episode is truncated, added up as highway-env does; inf for never.
        action_type: `discrete` lane-changing actions, or `continuous` [acceleration, steering] in [-1, 1].
        driver: `agent` executes the actions; `idm` replaces the ego with highway-env's IDMVehicle, `clairvoyant` drives it by
            plans that were tried in copies of the simulator.
        action_repeat: number of decisions for which an action is held; lane changes are sent once, then IDLE.
        target_speeds: increasing speeds in m/s for FASTER and SLOWER.
        reward_speed_range: speeds in m/s at which highway-env's speed reward is 0 and 1.
        progress: what is called progress.
        lane_weight: weight of the lane to the right in the progress of the highway; that of the speed is 0.4.
        reference_speed: speed in m/s that makes a progress of 1 on the way to the goal or along the lane.
        actions: numbers of the discrete actions LANE_LEFT to SLOWER, by the task's own numbers.
        idm: comfortable acceleration and braking in m/s2 and jam distance in m of the other cars.
        regulated: whether cars give way at crossings.
        view: what an observation is; the fields after `horizon` are for rows.
        horizon: seconds of a grid of times to collision.
        features: names of the columns of an observation.
        low, high: ranges of x, y, vx, vy that map to [-1, 1]; None for highway-env's defaults, which depend on the road.
        clipped: whether these four are clipped.
        relative: whether the other rows are relative to the ego.
        obstacles: whether obstacles are observed.
        slides: whether the tyres of an ego with continuous actions slip.
        steering_limit: largest steering angle of continuous actions in rad.
        observed_vehicles: number of rows in an observation, including the ego; at least 2.
        offroad_terminal: whether leaving the road ends the episode.
        odometer: whether `x` is the distance driven, because no direction is the forward one.
        shoulder: metres beside a lane in which a car has not left the road yet, for roads whose lanes do not meet exactly.

    Raises:
        ValueError: if a value is not allowed; the message is one line with the allowed values.
    """

    traffic: ClassVar[None] = None
    """No car is driven by orders."""

    task: TaskKind
    scenes: tuple[Scene, ...]
    simulation_frequency: int = 15
    policy_frequency: int = 1
    max_steps: int = 10**9
    duration: float = math.inf
    action_type: ActionType = "discrete"
    driver: Driver = "agent"
    action_repeat: int = 1
    target_speeds: tuple[float, ...] = DEFAULT_SPEEDS
    reward_speed_range: tuple[float, float] = (20.0, 30.0)
    progress: Measure = Measure.HIGHWAY
    lane_weight: float = 0.1
    reference_speed: float = 30.0
    actions: tuple[int, ...] = (0, 1, 2, 3, 4)
    idm: tuple[float, float, float] = (3.0, 5.0, 10.0)
    regulated: bool = False
    view: ViewKind = ViewKind.ROWS
    horizon: float = 0.0
    features: tuple[str, ...] = ("presence", "x", "y", "vx", "vy")
    low: tuple[float, ...] | None = None
    high: tuple[float, ...] | None = None
    clipped: bool = True
    relative: bool = True
    obstacles: bool = True
    observed_vehicles: int = 5
    offroad_terminal: bool = False
    slides: bool = False
    steering_limit: float = math.pi / 4
    odometer: bool = False
    shoulder: float = 0.0

    def __post_init__(self) -> None:
        if not self.scenes:
            raise ValueError("scenes must name at least one road")
        for name in ("simulation_frequency", "policy_frequency", "max_steps", "action_repeat"):
            value = getattr(self, name)
            if value != int(value) or value < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, got {value}")
        if not 2 <= self.observed_vehicles <= 1001:
            raise ValueError(
                f"observed_vehicles must be between 2 and 1001 (it counts the ego), got {self.observed_vehicles}"
            )
        if self.action_type not in get_args(ActionType):
            raise ValueError(f"action_type must be one of {', '.join(get_args(ActionType))}, got {self.action_type!r}")
        if self.driver not in get_args(Driver):
            raise ValueError(f"driver must be one of {', '.join(get_args(Driver))}, got {self.driver!r}")
        check_target_speeds(self.target_speeds)
        if len(self.target_speeds) > MOST_SPEEDS or not 1 <= len(self.features) <= MOST_COLUMNS:
            raise ValueError(f"there are at most {MOST_SPEEDS} target_speeds and {MOST_COLUMNS} features")
        known = [feature.name.lower() for feature in Feature]
        if strange := [name for name in self.features if name not in known]:
            raise ValueError(f"features must be among {', '.join(known)}, got {strange[0]!r}")
        if self.low is not None and self.high is not None:
            for name, low, high in zip(known, self.low, self.high, strict=False):
                if not -math.inf < low < high < math.inf:
                    raise ValueError(f"the range of {name} must be finite and increasing, got [{low:g}, {high:g}]")

    @property
    def batch(self) -> int:
        """Number of episodes."""
        return len(self.scenes)

    @property
    def substeps(self) -> int:
        """Physics frames per decision."""
        return self.simulation_frequency // self.policy_frequency

    @property
    def observed(self) -> tuple[int, int]:
        """Rows and columns of an observation."""
        if self.view == ViewKind.OCCUPANCY:
            return 24, 12
        if self.view == ViewKind.TIMES:
            return 9, int(self.horizon * self.policy_frequency)
        return self.observed_vehicles, len(self.features)

    @property
    def ego(self) -> Kind:
        """What the ego is."""
        if self.driver == "idm":
            return Kind.IDM
        return Kind.DISCRETE if self.action_type == "discrete" else Kind.CONTINUOUS


def parameters(config: RoadsConfig) -> NDArray[np.void]:
    """The configuration for the compiled engine: an array of one record `PARAMETERS`."""
    table = np.zeros(1, dtype=PARAMETERS)
    values = table[0]
    values["layout"] = config.view
    values["full_steps"] = config.max_steps
    for name in (
        "simulation_frequency",
        "task",
        "ego",
        "substeps",
        "max_steps",
        "action_repeat",
        "duration",
        "offroad_terminal",
        "slides",
        "progress",
        "lane_weight",
        "reference_speed",
        "odometer",
        "shoulder",
    ):
        values[name] = getattr(config, name)
    for name in ("clipped", "relative", "obstacles"):
        values[name] = getattr(config, name)
    values["dt"], values["period"] = 1 / config.simulation_frequency, 1 / config.policy_frequency
    values["speeds"], values["columns"] = len(config.target_speeds), len(config.features)
    values["target_speeds"][: len(config.target_speeds)] = config.target_speeds
    values["actions"][: len(config.actions)] = config.actions
    values["choices"] = len(config.actions)
    values["horizon"] = int(config.horizon / values["period"])
    values["regulation"] = int(1 / values["dt"] / REGULATIONS) if config.regulated else 0
    values["default_speeds"] = DEFAULT_SPEEDS
    values["features"][: len(config.features)] = [Feature[name.upper()] for name in config.features]
    values["idm_acceleration"], values["idm_braking"], values["jam_distance"] = config.idm
    values["gap_scale"] = 2 * math.sqrt(values["idm_acceleration"] * values["idm_braking"])
    values["reward_speed_low"], values["reward_speed_high"] = config.reward_speed_range
    values["default_range"] = config.low is None
    values["low"], values["high"] = config.low or (-1.0,) * 4, config.high or (1.0,) * 4
    return table
