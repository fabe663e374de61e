"""The batched engine: highway-env's `highway-v0` for B episodes at once, with identical results at every step.

Episodes are independent. A finished episode does not change, and costs no time, until it is reset.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, inner
from cavbench.envs.highway.collision import find_collisions
from cavbench.envs.highway.config import ACTIONS, HighwayConfig
from cavbench.envs.highway.dynamics import move
from cavbench.envs.highway.ego import apply_action, score, time_to_collision
from cavbench.envs.highway.observation import observe
from cavbench.envs.highway.ordered import COUNTS, order_batch
from cavbench.envs.highway.search import sort_by_position
from cavbench.envs.highway.sensor import noise_sigma, sensor_range_m
from cavbench.envs.highway.spawn import draw_words, lane_spacing, spawn_batch
from cavbench.envs.highway.state import (
    EPISODE,
    VEHICLE,
    EgoKind,
    Episode,
    Floats,
    Integers,
    Parameters,
    Vehicle,
    Vehicles,
    parameters,
)
from cavbench.envs.highway.traffic import act
from cavbench.envs.weather import WEATHERS


class Number(IntEnum):
    """Rows of `HighwayEngine.step`'s float32 output."""

    REWARD = 0
    PROGRESS = 1
    SPEED = 2
    X = 3
    TTC = 4


class Flag(IntEnum):
    """Rows of `HighwayEngine.step`'s boolean output."""

    DONE = 0
    TERMINATED = 1
    TRUNCATED = 2
    CRASHED = 3
    OFFROAD = 4


REWARD, PROGRESS, SPEED, X, TTC = (int(number) for number in Number)
DONE, TERMINATED, TRUNCATED, CRASHED, OFFROAD = (int(flag) for flag in Flag)


@inner
def advance(
    vehicles: Vehicles, order: Integers, places: Integers, corners: Floats, lanes: int, parameters: Parameters
) -> None:
    """AbstractEnv._simulate: the physics frames of one decision."""
    for _ in range(parameters.substeps):
        act(vehicles, order, places, lanes, parameters)
        for number in range(vehicles.size):
            move(vehicles[number], lanes, parameters.dt)
        sort_by_position(vehicles, order)
        find_collisions(vehicles, order, parameters.dt, parameters.others_collide, corners)


@inner
def drive(
    vehicles: Vehicles,
    order: Integers,
    episode: Episode,
    action: int,
    control: Floats,
    parameters: Parameters,
    places: Integers,
    corners: Floats,
) -> None:
    """One action of one episode: up to `action_repeat` decisions, fewer if the episode ends."""
    episode.reward = 0.0
    episode.progress = 0.0
    for held in range(parameters.action_repeat):
        apply_action(vehicles[0], action, control, held == 0, episode.lanes, parameters)
        advance(vehicles, order, places, corners, episode.lanes, parameters)
        episode.steps += 1
        score(vehicles, episode, parameters)
        if episode.terminated or episode.truncated:
            break
    episode.ttc = time_to_collision(vehicles, order)


@inner
def report(ego: Vehicle, episode: Episode, numbers: NDArray[np.float32], flags: NDArray[np.bool_], number: int) -> None:
    """Copy an episode's record into column `number` of the outputs."""
    numbers[REWARD, number] = episode.reward
    numbers[PROGRESS, number] = episode.progress
    numbers[SPEED, number] = ego.speed
    numbers[X, number] = ego.x
    numbers[TTC, number] = episode.ttc
    flags[DONE, number] = episode.terminated or episode.truncated
    flags[TERMINATED, number] = episode.terminated
    flags[TRUNCATED, number] = episode.truncated
    flags[CRASHED, number] = episode.crashed
    flags[OFFROAD, number] = episode.offroad


@entry_point
def step_batch(
    vehicles: NDArray[np.void],
    order: Integers,
    episodes: NDArray[np.void],
    actions: Integers,
    controls: Floats,
    paused: NDArray[np.bool_],
    parameters: Parameters,
    observation: NDArray[np.float32],
    numbers: NDArray[np.float32],
    flags: NDArray[np.bool_],
) -> None:
    """One action of every unfinished episode. See `HighwayEngine.step`."""
    places = np.empty(vehicles.shape[1], np.int64)
    corners = np.empty((2, 5, 2))
    rows = np.empty(observation.shape[1] - 1, np.int64)
    measured = np.empty(4)
    for number in range(episodes.size):
        episode, cars, sequence = episodes[number], vehicles[number], order[number]
        if paused[number] or episode.terminated or episode.truncated:
            numbers[REWARD, number] = 0.0
            numbers[PROGRESS, number] = 0.0
            continue
        drive(cars, sequence, episode, actions[number], controls[number], parameters, places, corners)
        observe(cars, sequence, episode, parameters, rows, measured, observation[number])
        report(cars[0], episode, numbers, flags, number)


@entry_point
def observe_batch(
    vehicles: NDArray[np.void],
    order: Integers,
    episodes: NDArray[np.void],
    chosen: Integers,
    parameters: Parameters,
    observation: NDArray[np.float32],
    numbers: NDArray[np.float32],
    flags: NDArray[np.bool_],
) -> None:
    """Write the current observation and record of the episodes `chosen` [R], without a step."""
    rows = np.empty(observation.shape[1] - 1, np.int64)
    measured = np.empty(4)
    for number in chosen:
        episode, cars, sequence = episodes[number], vehicles[number], order[number]
        episode.ttc = time_to_collision(cars, sequence)
        observe(cars, sequence, episode, parameters, rows, measured, observation[number])
        report(cars[0], episode, numbers, flags, number)


class HighwayEngine:
    """B episodes of `config`, in numpy. The engine owns the outputs and overwrites them in the next call.

    Attributes:
        observation: float32 [B, V, 5].
        numbers: float32 [5, B]; rows as in `Number`.
        flags: bool [5, B]; rows as in `Flag`.
        vehicles: [B, vehicles + 1] records `VEHICLE`, in highway-env's order.
        episodes: [B] records `EPISODE`.
        orders: int64 [B, 4] what came of the orders to cars that are driven; columns as in `cavbench.envs.highway.ordered`.
    """

    def __init__(self, config: HighwayConfig) -> None:
        batch, size = config.batch, config.vehicles + 1
        self.config = config
        self.parameters = parameters(config)
        self.vehicles = np.zeros((batch, size), dtype=VEHICLE)
        self.order = np.tile(np.arange(size, dtype=np.int64), (batch, 1))
        self.episodes = np.zeros(batch, dtype=EPISODE)
        self.observation = np.zeros((batch, config.observed_vehicles, 5), dtype=np.float32)
        self.numbers = np.zeros((len(Number), batch), dtype=np.float32)
        self.flags = np.zeros((len(Flag), batch), dtype=np.bool_)
        weathers = [WEATHERS[cell.weather] for cell in config.cells]
        self.episodes["lanes"] = [cell.lanes for cell in config.cells]
        self.episodes["sensor_range"] = [sensor_range_m(weather) for weather in weathers]
        self.episodes["noise_sigma"] = [noise_sigma(weather) for weather in weathers]
        # No episode runs before its reset.
        self.episodes["truncated"] = True
        self._traffic_spacing = np.array([1 / cell.density for cell in config.cells])
        self._lane_factor = lane_spacing(self.episodes["lanes"])
        self._no_actions = np.ones(batch, dtype=np.int64)
        self._no_controls = np.zeros((batch, 2))
        self._no_pause = np.zeros(batch, dtype=np.bool_)
        self.orders = np.zeros((batch, COUNTS), dtype=np.int64)

    def reset(self, chosen: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        """Start the episodes `chosen` [R] (row numbers) from the scenario seeds [R].

        Raises:
            ValueError: if a seed is negative.
        """
        check_seeds(seeds)
        for name in ("steps", "reward", "progress", "crashed", "offroad", "terminated", "truncated"):
            self.episodes[name][chosen] = 0
        self.episodes["seed"][chosen] = seeds
        self.orders[chosen] = 0
        spawn_batch(
            self.vehicles,
            self.order,
            self.episodes,
            chosen,
            draw_words(seeds, self.config.vehicles),
            float(self.config.ego_spacing),
            self._traffic_spacing[chosen],
            self._lane_factor[chosen],
            self.parameters,
        )
        observe_batch(
            self.vehicles,
            self.order,
            self.episodes,
            chosen,
            self.parameters,
            self.observation,
            self.numbers,
            self.flags,
        )

    def order_cars(self, orders: NDArray[np.float64], paused: NDArray[np.bool_] | None = None) -> None:
        """Give orders to cars of the traffic for the next decision, within `config.traffic`.

        Args:
            orders: float64 [B, vehicles + 1, 3]: above 0 for a car to drive, its acceleration in m/s2, and where it steers to, in
                m across the road. Numbers that are not finite are no order.
            paused: as in `step`.
        """
        given = np.ascontiguousarray(orders, dtype=np.float64)
        if not np.isfinite(given).all():
            given = np.where(np.isfinite(given).all(-1, keepdims=True), given, 0.0)
        order_batch(
            self.vehicles,
            self.episodes,
            given,
            self._no_pause if paused is None else paused,
            self.parameters.bounds,
            self.orders,
        )

    def step(self, action: NDArray[np.generic], paused: NDArray[np.bool_] | None = None) -> None:
        """Execute one action in each episode; finished and paused episodes do not change and have reward 0.

        Args:
            action: int64 [B] indices into `ACTIONS`, or float32 [B, 2] acceleration and steering in [-1, 1] (clipped).
            paused: bool [B], episodes that do not step, besides the finished ones.

        Raises:
            ValueError: if a discrete action is not an index into `ACTIONS`.
        """
        actions, controls = self._no_actions, self._no_controls
        if self.parameters.ego == EgoKind.DISCRETE:
            # Always one memory layout: numba would compile again for another one.
            actions = np.ascontiguousarray(action, dtype=np.int64)
            if actions.min() < 0 or actions.max() >= len(ACTIONS):
                raise ValueError(f"actions must be between 0 and {len(ACTIONS) - 1}, got {actions.tolist()}")
        elif self.parameters.ego == EgoKind.CONTINUOUS:
            controls = physical_controls(np.asarray(action))
        step_batch(
            self.vehicles,
            self.order,
            self.episodes,
            actions,
            controls,
            self._no_pause if paused is None else paused,
            self.parameters,
            self.observation,
            self.numbers,
            self.flags,
        )


def check_seeds(seeds: Integers) -> None:
    """Raise ValueError for seeds that numpy's generators refuse."""
    if (seeds < 0).any():
        raise ValueError(f"scenario seeds must be at least 0, got {seeds.min()}")


def physical_controls(action: NDArray[np.floating], limit: float = np.pi / 4) -> NDArray[np.float64]:
    """[B, 2] m/s2 and rad, the latter at most `limit`: ContinuousAction.get_action, in the action's own precision as there."""
    clipped = np.clip(action, -1, 1)
    acceleration = -5 + (clipped[:, 0] + 1) * (5.0 - -5) / 2
    steering = -limit + (clipped[:, 1] + 1) * (limit - -limit) / 2
    return np.stack([acceleration, steering], axis=1).astype(np.float64)
