"""B episodes in SUMO's traffic: the ego is moved, and everything is measured, by the code of `highway`; SUMO moves the traffic.

A step: the ego acts and moves by itself. SUMO is told where the ego then is, and moves all others, which see it where it was.
Then collisions, progress and observation are computed from where all bodies are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, inner
from cavbench.envs.highway.collision import DIAGONAL, fill_corners, polygons_intersect
from cavbench.envs.highway.config import ACTIONS, HighwayConfig
from cavbench.envs.highway.dynamics import (
    LANE_WIDTH,
    VEHICLE_LENGTH,
    closest_lane,
    move,
    speed_control,
    steering_control,
    update_direction,
    wrap_to_pi,
)
from cavbench.envs.highway.ego import apply_action, score, speed_share
from cavbench.envs.highway.engine import (
    HighwayEngine,
    Number,
    check_seeds,
    observe_batch,
    physical_controls,
)
from cavbench.envs.highway.search import sort_by_position
from cavbench.envs.highway.state import EgoKind, Episode, Floats, Integers, Parameters, Vehicle, Vehicles
from cavbench.envs.sumo.cars import PERIOD_MS, Model
from cavbench.envs.sumo.processes import Processes
from cavbench.envs.sumo.roads import Road
from cavbench.scenarios import Cell

DISCRETE, IDM = int(EgoKind.DISCRETE), int(EgoKind.IDM)
NOWHERE = -1e6
"""x and y in m of cars that are not there."""


@inner
def to_sumo(vehicle: Vehicle, place: Floats) -> None:
    """Write SUMO's columns [4] of a body: it has the front bumper, y to the left, and degrees clockwise from north."""
    half = VEHICLE_LENGTH / 2
    place[0] = vehicle.x + half * vehicle.cos_heading
    place[1] = -(vehicle.y + half * vehicle.sin_heading) - LANE_WIDTH / 2
    place[2] = vehicle.speed
    place[3] = 90.0 + math.degrees(vehicle.heading)


@inner
def from_sumo(place: Floats, vehicle: Vehicle, lanes: int) -> None:
    """Put a body where SUMO's columns [4] say."""
    if math.isnan(place[0]):
        vehicle.x = vehicle.y = NOWHERE
        vehicle.speed = 0.0
        return
    vehicle.heading = wrap_to_pi(math.radians(place[3] - 90.0))
    update_direction(vehicle)
    half = VEHICLE_LENGTH / 2
    vehicle.x = place[0] - half * vehicle.cos_heading
    vehicle.y = -place[1] - LANE_WIDTH / 2 - half * vehicle.sin_heading
    vehicle.speed = place[2]
    vehicle.lane = closest_lane(vehicle.x, vehicle.y, vehicle.heading, lanes)
    vehicle.target_lane = vehicle.lane


@inner
def hits(vehicles: Vehicles, corners: Floats) -> int:
    """The car whose body overlaps the ego's, -1 for none; `corners` [2, 5, 2] is a work array.

    A car moves less than half its length against another one in a step, so that none is jumped over.
    """
    ego = vehicles[0]
    fill_corners(ego, corners[0])
    for number in range(1, vehicles.size):
        x, y = vehicles[number].x - ego.x, vehicles[number].y - ego.y
        if x * x + y * y > DIAGONAL * DIAGONAL:
            continue
        fill_corners(vehicles[number], corners[1])
        if polygons_intersect(corners[0], corners[1], 0.0, 0.0)[0]:
            return number
    return -1


@entry_point
def move_egos(
    vehicles: NDArray[np.void],
    episodes: NDArray[np.void],
    actions: Integers,
    controls: Floats,
    moving: NDArray[np.bool_],
    first: bool,
    parameters: Parameters,
    places: Floats,
) -> None:
    """The ego's action in the episodes `moving` [B]; `places` [B, 4] is where SUMO must put it, NaN if that is not said."""
    for number in range(episodes.size):
        places[number] = np.nan
        if not moving[number] or parameters.ego == IDM:
            continue
        ego, lanes = vehicles[number, 0], episodes[number].lanes
        apply_action(ego, actions[number], controls[number], first, lanes, parameters)
        if parameters.ego == DISCRETE:
            ego.steering = steering_control(ego, ego.target_lane)
            ego.acceleration = speed_control(ego)
        move(ego, lanes, parameters.dt)
        to_sumo(ego, places[number])


@inner
def take_places(vehicles: Vehicles, order: Integers, episode: Episode, places: Floats, parameters: Parameters) -> None:
    """Put the cars where SUMO has them [N, 4]; the ego, too, if SUMO drives it."""
    for number in range(0 if parameters.ego == IDM else 1, vehicles.size):
        from_sumo(places[number], vehicles[number], episode.lanes)
    sort_by_position(vehicles, order)


@entry_point
def place_chosen(
    vehicles: NDArray[np.void],
    order: Integers,
    episodes: NDArray[np.void],
    chosen: Integers,
    places: Floats,
    parameters: Parameters,
) -> None:
    """The start of the episodes `chosen` [R], from SUMO's columns [B, N, 4]."""
    for number in chosen:
        cars, episode = vehicles[number], episodes[number]
        cars[0].crashed = False
        # No push of a collision is pending.
        cars[0].impact_pair = -1
        from_sumo(places[number, 0], cars[0], episode.lanes)
        take_places(cars, order[number], episode, places[number], parameters)


@entry_point
def judge(
    vehicles: NDArray[np.void],
    order: Integers,
    episodes: NDArray[np.void],
    moving: NDArray[np.bool_],
    places: Floats,
    speed_alone: bool,
    parameters: Parameters,
) -> None:
    """What came of a step in the episodes `moving` [B]; only the speed is progress if `speed_alone`."""
    corners = np.empty((2, 5, 2))
    for number in range(episodes.size):
        if moving[number]:
            cars, episode = vehicles[number], episodes[number]
            take_places(cars, order[number], episode, places[number], parameters)
            cars[0].crashed = hits(cars, corners) >= 0
            episode.steps += 1
            before = episode.progress
            score(cars, episode, parameters)
            if speed_alone and not (episode.crashed or episode.offroad):
                episode.progress = before + speed_share(cars[0], parameters)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Where the traffic drives.

    Args:
        layout: name of the layout of the roads.
        road: the road of a cell.
        start: the cars at the start, from row, seed, cell, number of cars of the traffic and what drives the ego.
        speed_alone: whether only the speed is progress, and not the lane.
    """

    layout: str
    road: Callable[[Cell], Road]
    start: Callable[[int, int, Cell, int, Model], NDArray[np.void]]
    speed_alone: bool = False


class SumoEngine(HighwayEngine):
    """B episodes of `config`, whose traffic SUMO drives.

    Args:
        config: of `highway`; its physics frames are one a decision.
        scene: where.
        processes: number of simulations that hold the batch.

    Raises:
        UserError: if SUMO is not installed, or cannot start.
    """

    def __init__(self, config: HighwayConfig, scene: Scene, processes: int = 1) -> None:
        super().__init__(config)
        # SUMO's step is no whole share of a second.
        self.parameters = self.parameters._replace(dt=PERIOD_MS / 1000)
        self.scene = scene
        self.ego = Model.IDM if config.driver == "idm" else Model.EGO
        self.places = np.full((config.batch, 4), np.nan)
        roads = [scene.road(cell) for cell in config.cells]
        self.processes = Processes(scene.layout, roads, config.vehicles + 1, processes)

    def reset(self, chosen: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        """See `HighwayEngine.reset`."""
        check_seeds(seeds)
        for name in ("steps", "reward", "progress", "crashed", "offroad", "terminated", "truncated"):
            self.episodes[name][chosen] = 0
        self.episodes["seed"][chosen] = seeds
        self.processes.remove(chosen)
        if len(chosen):
            self.processes.create(np.concatenate([self._cars(*pair) for pair in zip(chosen, seeds, strict=True)]))
        arrays = self.vehicles, self.order, self.episodes
        place_chosen(*arrays, chosen, self.processes.state(), self.parameters)
        self.vehicles["target_speed"][chosen, 0] = self.vehicles["speed"][chosen, 0]
        outputs = self.observation, self.numbers, self.flags
        observe_batch(*arrays, chosen, self.parameters, *outputs)

    def _cars(self, row: np.int64, seed: np.int64) -> NDArray[np.void]:
        cell = self.config.cells[row]
        return self.scene.start(int(row), int(seed), cell, self.config.vehicles, self.ego)

    def step(self, action: NDArray[np.generic], paused: NDArray[np.bool_] | None = None) -> None:
        """See `HighwayEngine.step`.

        Raises:
            ValueError: if a discrete action is not an index into `ACTIONS`, or an unfinished episode is to be paused.
        """
        actions, controls = self._no_actions, self._no_controls
        if self.parameters.ego == EgoKind.DISCRETE:
            actions = np.ascontiguousarray(action, dtype=np.int64)
            if actions.min() < 0 or actions.max() >= len(ACTIONS):
                raise ValueError(f"actions must be between 0 and {len(ACTIONS) - 1}, got {actions.tolist()}")
        elif self.parameters.ego == EgoKind.CONTINUOUS:
            controls = physical_controls(np.asarray(action))
        moved = ~self._ended()
        if paused is not None and (paused & moved).any():
            raise ValueError("SUMO steps all episodes of a batch together: none can be paused")
        self.episodes["reward"][moved] = 0.0
        self.episodes["progress"][moved] = 0.0
        for held in range(self.parameters.action_repeat):
            moving = ~self._ended()
            if not moving.any():
                break
            move_egos(self.vehicles, self.episodes, actions, controls, moving, held == 0, self.parameters, self.places)
            places = self.processes.step(self.places)
            arrays = self.vehicles, self.order, self.episodes
            judge(*arrays, moving, places, self.scene.speed_alone, self.parameters)
            # SUMO need not drive what nobody sees any more.
            self.processes.remove(np.flatnonzero(moving & self._ended()))
        outputs = self.observation, self.numbers, self.flags
        # All others have no reward and no progress.
        self.numbers[Number.REWARD, ~moved] = self.numbers[Number.PROGRESS, ~moved] = 0.0
        observe_batch(self.vehicles, self.order, self.episodes, np.flatnonzero(moved), self.parameters, *outputs)

    def _ended(self) -> NDArray[np.bool_]:
        """[B] whether an episode is over, or was never started."""
        return np.asarray(self.episodes["terminated"] | self.episodes["truncated"])
