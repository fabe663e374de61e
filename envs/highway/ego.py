"""The ego's actions and reward: highway-env's MDPVehicle and HighwayEnv._reward."""

from __future__ import annotations

import numpy as np

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import (
    DISCRETE,
    IDM,
    VEHICLE_LENGTH,
    clip,
    is_on_lane,
    is_reachable,
    linear_map,
    weigh,
)
from cavbench.envs.highway.search import front_vehicle
from cavbench.envs.highway.state import Episode, Floats, Integers, Parameters, Vehicle, Vehicles

LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER = range(5)
PROGRESS_LANE, PROGRESS_SPEED = 0.1, 0.4
"""Weights of Eq. 4.1 in `progress`; the configured reward weights do not change them, because `progress` is a metric."""


@inner
def nearest_target_speed(speed: float, target_speeds: Floats) -> int:
    """MDPVehicle.speed_to_index: the entry of the (uniform) table closest to a speed."""
    last = target_speeds.size - 1
    share = (speed - target_speeds[0]) / (target_speeds[last] - target_speeds[0])
    return int(clip(np.rint(share * last), 0.0, float(last)))


@inner
def apply_meta_action(ego: Vehicle, action: int, lanes: int, target_speeds: Floats) -> None:
    """MDPVehicle.act: change the target speed or the target lane."""
    if action in (FASTER, SLOWER):
        change = 1 if action == FASTER else -1
        index = nearest_target_speed(ego.speed, target_speeds) + change
        ego.target_speed = target_speeds[min(max(index, 0), target_speeds.size - 1)]
    elif action in (LANE_LEFT, LANE_RIGHT):
        change = 1 if action == LANE_RIGHT else -1
        lane = min(max(ego.target_lane + change, 0), lanes - 1)
        if is_reachable(ego, lane):
            ego.target_lane = lane


@inner
def apply_action(ego: Vehicle, action: int, control: Floats, first: bool, lanes: int, parameters: Parameters) -> None:
    """Apply the action to the ego; if an action is held, a lane change is applied only the `first` time.

    Args:
        action: number of the discrete action.
        control: [2] acceleration in m/s2 and steering in rad of the continuous action.
    """
    if parameters.ego == IDM:
        return
    if parameters.ego == DISCRETE:
        if first or action in (FASTER, SLOWER):
            apply_meta_action(ego, action, lanes, parameters.target_speeds)
    else:
        ego.acceleration = control[0]
        ego.steering = control[1]
        weigh(ego, parameters.mass, parameters.grip)


@inner
def speed_share(ego: Vehicle, parameters: Parameters) -> float:
    """Forward speed, mapped from the rewarded range to [0, 1]."""
    forward = ego.speed * ego.cos_heading
    low, high = parameters.reward_speed_low, parameters.reward_speed_high
    return clip(linear_map(forward, low, high, 0.0, 1.0), 0.0, 1.0)


@inner
def lane_share(ego: Vehicle, lanes: int, parameters: Parameters) -> float:
    """Position to the right, in [0, 1]: of the target lane, or of the current lane for a continuous ego."""
    lane = ego.target_lane if parameters.ego in (DISCRETE, IDM) else ego.lane
    return lane / max(lanes - 1, 1)


@inner
def reward(ego: Vehicle, on_road: bool, lane: float, speed: float, parameters: Parameters) -> float:
    """HighwayEnv._reward from the shares `lane` and `speed`."""
    value = parameters.collision_reward * (1.0 if ego.crashed else 0.0)
    value += parameters.right_lane_reward * lane
    value += parameters.high_speed_reward * speed
    if parameters.normalize_reward:
        best = parameters.high_speed_reward + parameters.right_lane_reward
        value = linear_map(value, parameters.collision_reward, best, 0.0, 1.0)
    return value if on_road else value * 0.0


@inner
def time_to_collision(vehicles: Vehicles, order: Integers) -> float:
    """Seconds until the ego hits the car ahead in its lane at their current speeds; inf if never."""
    place = 0
    while order[place] != 0:
        place += 1
    ego = vehicles[0]
    leader = front_vehicle(vehicles, order, place, ego.lane)
    if leader < 0:
        return np.inf
    other = vehicles[leader]
    closing = ego.speed * ego.cos_heading - other.speed * other.cos_heading
    if closing <= 0:
        return np.inf
    return max(other.x - ego.x - VEHICLE_LENGTH, 0.0) / closing


@inner
def score(vehicles: Vehicles, episode: Episode, parameters: Parameters) -> None:
    """Update the episode's record after one decision; reward and progress are sums."""
    ego = vehicles[0]
    on_road = is_on_lane(ego, ego.lane, 0.0)
    lane, speed = lane_share(ego, episode.lanes, parameters), speed_share(ego, parameters)
    episode.reward += reward(ego, on_road, lane, speed, parameters)
    episode.crashed = ego.crashed
    episode.offroad = not on_road
    if on_road and not ego.crashed:
        episode.progress += (PROGRESS_LANE * lane + PROGRESS_SPEED * speed) / (PROGRESS_LANE + PROGRESS_SPEED)
    episode.terminated = ego.crashed or (parameters.offroad_terminal and not on_road)
    episode.truncated = episode.steps >= parameters.max_steps
