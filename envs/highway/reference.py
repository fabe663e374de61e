"""The reference environment: the real highway-env behind the same TorchRL interface, one episode after the other.

highway-env itself computes everything that the engine computes; this module adds only the weather's noise, the scoring record
and the loop over episodes. Use it to check the engine, or to render.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env.envs.common.observation import KinematicObservation
from highway_env.envs.highway_env import HighwayEnv as FaramaHighwayEnv
from highway_env.vehicle.behavior import IDMVehicle
from numpy.typing import NDArray

from cavbench.envs.highway.config import ACTIONS, HighwayConfig
from cavbench.envs.highway.constants import own_constants
from cavbench.envs.highway.dynamics import VEHICLE_LENGTH
from cavbench.envs.highway.ego import PROGRESS_LANE, PROGRESS_SPEED
from cavbench.envs.highway.engine import Flag, Number, check_seeds
from cavbench.envs.highway.environment import HighwayEnv
from cavbench.envs.highway.sensor import FEATURES, add_noise, noise_sigma, sensor_range_m
from cavbench.envs.weather import WEATHERS
from cavbench.scenarios import Cell

IDLE = ACTIONS.index("IDLE")
LANE_CHANGES = (ACTIONS.index("LANE_LEFT"), ACTIONS.index("LANE_RIGHT"))


def farama_config(config: HighwayConfig, cell: Cell) -> dict[str, Any]:
    """highway-env's configuration dictionary for `config` and one of its cells."""
    features = config.features_on(cell.lanes)
    ranges = {name: [low, high] for name, low, high in zip(features.names, features.low, features.high, strict=True)}
    discrete: dict[str, Any] = {"type": "DiscreteMetaAction", "target_speeds": list(config.target_speeds)}
    continuous = {"type": "ContinuousAction"}
    return {
        "lanes_count": cell.lanes,
        "vehicles_count": config.vehicles,
        "vehicles_density": cell.density,
        "ego_spacing": config.ego_spacing,
        "simulation_frequency": config.simulation_frequency,
        "policy_frequency": config.policy_frequency,
        # highway-env's own limit is one step late because of floating-point time, so steps are counted instead.
        "duration": float("inf"),
        # The IDM driver replaces an ego with a target lane and speed, so the ignored actions must be discrete.
        "action": discrete if config.driver == "idm" or config.action_type == "discrete" else continuous,
        "observation": {
            "type": "Kinematics",
            "vehicles_count": config.observed_vehicles,
            "features": ["presence", *features.names],
            "features_range": ranges,
        },
        "collision_reward": config.collision_reward,
        "right_lane_reward": config.right_lane_reward,
        "high_speed_reward": config.high_speed_reward,
        "reward_speed_range": list(config.reward_speed_range),
        "normalize_reward": config.normalize_reward,
        "offroad_terminal": config.offroad_terminal,
        "initial_lane_id": config.start_lane,
    }


class SensedKinematics(KinematicObservation):
    """highway-env's observation with the weather's noise, added before the normalisation."""

    env: SensedHighwayEnv

    def normalize_obs(self, df: Any) -> Any:
        """Add noise to the rows of the other vehicles, then normalise and clip like highway-env."""
        if self.env.noise_sigma > 0:
            measured = df[list(self.env.feature_names)].to_numpy(dtype=np.float64, copy=True)
            for row, number in enumerate(self._seen(), start=1):
                add_noise(measured[row], self.env.noise_sigma, self.env.scenario_seed, self.env.decisions, number)
            df = df.assign(**dict(zip(self.env.feature_names, measured.T, strict=True)))
        return super().normalize_obs(df)

    def _seen(self) -> list[int]:
        """Numbers of the vehicles in the rows after the ego's, as selected by highway-env."""
        seen = self.env.road.close_objects_to(
            self.observer_vehicle,
            self.env.PERCEPTION_DISTANCE,
            count=self.vehicles_count - 1,
            see_behind=self.see_behind,
            sort=True,
        )
        return [next(n for n, other in enumerate(self.env.road.vehicles) if other is vehicle) for vehicle in seen]


class SensedHighwayEnv(FaramaHighwayEnv):
    """highway-env with a weather sensor and, with `driver=idm`, its IDM driver as the ego.

    Args:
        config: the environment's configuration.
        cell: lanes, density and weather.
        render_mode: as in gymnasium.
    """

    def __init__(self, config: HighwayConfig, cell: Cell, render_mode: str | None = None) -> None:
        weather = WEATHERS[cell.weather]
        self.PERCEPTION_DISTANCE = sensor_range_m(weather)
        self.noise_sigma = noise_sigma(weather)
        self.feature_names = config.features.names[:FEATURES]
        self.idm_ego, self.others_collide = config.driver == "idm", config.others_collide
        self.scenario_seed = 0
        self.decisions = 0
        super().__init__(config=farama_config(config, cell), render_mode=render_mode)

    def define_spaces(self) -> None:
        """highway-env's spaces, with `SensedKinematics` as observation."""
        super().define_spaces()
        self.observation_type = SensedKinematics(self, **self.config["observation"])

    def _create_vehicles(self) -> None:
        super()._create_vehicles()
        if self.idm_ego:
            ego = IDMVehicle.create_from(self.vehicle)
            self.road.vehicles[0] = ego
            self.controlled_vehicles = [ego]
        for other in self.road.vehicles[1:]:
            other.check_collisions = self.others_collide

    def start(self, seed: int) -> NDArray[np.float32]:
        """Reset to a scenario and return its observation [V, 5]."""
        self.scenario_seed, self.decisions = seed, 0
        with own_constants():
            observation, _ = self.reset(seed=seed)
        return observation

    def decide(self, action: Any) -> tuple[NDArray[np.float32], float, bool]:
        """Make one decision; return observation [V, 5], reward and terminated."""
        self.decisions += 1
        # An IDMVehicle must act once per frame; with an action, highway-env would call it twice.
        with own_constants():
            observation, reward, terminated, _, _ = self.step(None if self.idm_ego else action)
        return observation, float(reward), bool(terminated)

    def progress(self) -> float:
        """Eq. 4.1 without its offset, in [0, 1]; 0 after a crash or off the road."""
        rewards = self._rewards(None)
        if self.vehicle.crashed or not self.vehicle.on_road:
            return 0.0
        earned = PROGRESS_LANE * rewards["right_lane_reward"] + PROGRESS_SPEED * rewards["high_speed_reward"]
        return float(earned / (PROGRESS_LANE + PROGRESS_SPEED))

    def time_to_collision(self) -> float:
        """Time to collision in seconds, as in `cavbench.envs.highway.ego.time_to_collision`."""
        ego = self.vehicle
        leader, _ = self.road.neighbour_vehicles(ego, ego.lane_index)
        if leader is None:
            return float("inf")
        closing = ego.velocity[0] - leader.velocity[0]
        if closing <= 0:
            return float("inf")
        return float(max(leader.position[0] - ego.position[0] - VEHICLE_LENGTH, 0.0) / closing)


class ReferenceHighway(HighwayEnv):
    """`HighwayEnv` on the real highway-env, in a loop over the episodes."""

    def __init__(self, config: HighwayConfig, render_mode: str | None = None) -> None:
        super().__init__(config)
        self.simulators = [SensedHighwayEnv(config, cell, render_mode) for cell in config.cells]
        self._observation = np.zeros((config.batch, config.observed_vehicles, 5), dtype=np.float32)
        self._numbers = np.zeros((len(Number), config.batch), dtype=np.float32)
        self._flags = np.zeros((len(Flag), config.batch), dtype=np.bool_)

    def _start(self, chosen: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        check_seeds(seeds)
        for number, seed in zip(chosen.tolist(), seeds.tolist(), strict=True):
            self._observation[number] = self.simulators[number].start(seed)
            self._report(number, 0.0, 0.0, terminated=False)

    def _drive(self, action: NDArray[np.generic], paused: NDArray[np.bool_] | None) -> None:
        for number in range(self.config.batch):
            if self._flags[Flag.DONE, number] or (paused is not None and paused[number]):
                self._numbers[[Number.REWARD, Number.PROGRESS], number] = 0.0
            else:
                self._drive_one(number, action[number])

    def _drive_one(self, number: int, action: Any) -> None:
        """Execute one action in one episode, for `action_repeat` decisions."""
        simulator = self.simulators[number]
        reward = progress = 0.0
        for held in range(self.config.action_repeat):
            sent = self.config.action_type == "discrete" and held > 0 and int(action) in LANE_CHANGES
            self._observation[number], earned, terminated = simulator.decide(IDLE if sent else action)
            reward += earned
            progress += simulator.progress()
            if terminated or simulator.decisions >= self.config.max_steps:
                break
        self._report(number, reward, progress, terminated=terminated)

    def _report(self, number: int, reward: float, progress: float, *, terminated: bool) -> None:
        """Fill column `number` of the outputs."""
        simulator = self.simulators[number]
        ego = simulator.vehicle
        truncated = simulator.decisions >= self.config.max_steps
        ttc = simulator.time_to_collision()
        self._numbers[:, number] = reward, progress, ego.speed, ego.position[0], ttc
        self._flags[:, number] = terminated or truncated, terminated, truncated, ego.crashed, not ego.on_road

    def _outputs(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        return self._observation, self._numbers, self._flags
