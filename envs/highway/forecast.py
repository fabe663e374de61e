"""The highway's dynamics for attackers: beliefs from observations, and forecasts from beliefs, on the compiled engine."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench.compiled import entry_point
from cavbench.driving.dynamics import Dynamics, Forecast
from cavbench.envs.highway.belief import track_batch
from cavbench.envs.highway.collision import find_collisions
from cavbench.envs.highway.config import ACTIONS, HighwayConfig
from cavbench.envs.highway.dynamics import is_on_lane, move
from cavbench.envs.highway.ego import PROGRESS_LANE, PROGRESS_SPEED, apply_action, lane_share, speed_share
from cavbench.envs.highway.engine import physical_controls
from cavbench.envs.highway.ordered import COUNTS, take_orders
from cavbench.envs.highway.rehearsal import HighwayRehearsal
from cavbench.envs.highway.search import sort_by_position
from cavbench.envs.highway.sensor import sensor_range_m
from cavbench.envs.highway.state import VEHICLE, EgoKind, Floats, Integers, Parameters, parameters
from cavbench.envs.highway.traffic import act
from cavbench.envs.weather import WEATHERS

FIELDS = ("x", "y", "heading", "speed", "target_speed", "timer", "delta", "lane", "target_lane")
"""The fields of a vehicle that a belief holds."""

NEAR_AHEAD, NEAR_BEHIND = 150.0, 60.0
"""Cars within this distance of the ego in m are simulated; the others hardly matter within a few seconds."""


@entry_point
def roll_batch(
    cars: NDArray[np.void],
    counts: Integers,
    actions: Integers,
    controls: Floats,
    orders: Floats,
    lanes: Integers,
    parameters: Parameters,
    failed: Integers,
    crashed: NDArray[np.bool_],
    progress: NDArray[np.float32],
) -> None:
    """Simulate every plan from every belief; see `HighwayDynamics.roll`.

    Args:
        cars: beliefs [B, N], of which the first `counts` [B] are known.
        actions: [B, P, T]; controls: [B, P, T, 2].
        orders: [B, T, N, 3] orders to cars that are driven; with T = 0 they go on as they were ordered last.
        lanes: of each episode [B].
        failed, crashed, progress: outputs [B, P].
    """
    size = cars.shape[1]
    near, copy = np.empty_like(cars[0]), np.empty_like(cars[0])
    order, ordered, places = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    corners, counted = np.empty((2, 5, 2)), np.zeros(COUNTS, np.int64)
    numbers, given = np.empty(size, np.int64), np.empty((size, 3))
    for episode in range(cars.shape[0]):
        count = 0
        for number in range(counts[episode]):
            ahead = cars[episode, number].x - cars[episode, 0].x
            if -NEAR_BEHIND < ahead < NEAR_AHEAD:
                near[count : count + 1] = cars[episode, number : number + 1]
                ordered[count] = count
                numbers[count] = number
                count += 1
        sort_by_position(near, ordered[:count])
        for plan in range(actions.shape[1]):
            copy[:count] = near[:count]
            order[:count] = ordered[:count]
            vehicles, sequence, ego = copy[:count], order[:count], copy[0]
            total, step, road = 0.0, 0, lanes[episode]
            while step < actions.shape[2]:
                if step < orders.shape[1]:
                    for place in range(count):
                        given[place] = orders[episode, step, numbers[place]]
                    take_orders(vehicles, given[:count], road, parameters.bounds, counted)
                apply_action(ego, actions[episode, plan, step], controls[episode, plan, step], True, road, parameters)
                for _ in range(parameters.substeps):
                    act(vehicles, sequence, places[:count], road, parameters)
                    for number in range(count):
                        move(vehicles[number], road, parameters.dt)
                    sort_by_position(vehicles, sequence)
                    find_collisions(vehicles, sequence, parameters.dt, parameters.others_collide, corners)
                if ego.crashed or not is_on_lane(ego, ego.lane, 0.0):
                    break
                share = PROGRESS_LANE * lane_share(ego, road, parameters) + PROGRESS_SPEED * speed_share(
                    ego, parameters
                )
                total += share / (PROGRESS_LANE + PROGRESS_SPEED)
                step += 1
            failed[episode, plan] = step
            crashed[episode, plan] = ego.crashed
            progress[episode, plan] = total


class HighwayDynamics(Dynamics):
    """The highway's rules of motion on the roads of some cells.

    Args:
        config: configuration with the cell of each episode; its other values are parameters of the world, which are no secret.
    """

    def __init__(self, config: HighwayConfig) -> None:
        self.config, self.parameters = config, parameters(config)
        self.action_type, self.period = config.action_type, 1 / config.policy_frequency
        self.actions = len(ACTIONS) if config.action_type == "discrete" else 0
        low, high = self.parameters.low, self.parameters.high
        self._half, self._centre = (high - low) / 2, (high + low) / 2

    def unknown(self) -> TensorDict:
        cells = self.config.cells
        ranges = [sensor_range_m(WEATHERS[cell.weather]) for cell in cells]
        road = {
            "lanes": torch.tensor([cell.lanes for cell in cells]),
            "sensor_range": torch.tensor(ranges, dtype=torch.float64),
        }
        size = (len(cells), self.config.vehicles + 1)
        fields = {name: torch.zeros(size, dtype=torch.float64) for name in FIELDS}
        count = torch.zeros(len(cells), dtype=torch.int64)
        return TensorDict({**fields, **road, "count": count}, batch_size=[len(cells)])

    def believe(self, observation: Tensor, before: TensorDictBase) -> TensorDict:
        cars, counts = self._records(before)
        normalised = observation.numpy().astype(np.float64)
        lanes, sensor_range = before["lanes"], before["sensor_range"]
        half, centre = (table[lanes.numpy()][:, None] for table in (self._half, self._centre))
        rows = normalised.copy()
        rows[..., 1:] = normalised[..., 1:] * half + centre
        clipped = (np.abs(normalised[..., 1:]) >= 1).any(-1)
        track_batch(cars, counts, rows, clipped, lanes.numpy(), sensor_range.numpy(), self.parameters)
        fields = {name: torch.from_numpy(cars[name].astype(np.float64)) for name in FIELDS}
        road = {"lanes": lanes, "sensor_range": sensor_range}
        return TensorDict({**fields, **road, "count": torch.from_numpy(counts)}, batch_size=[len(counts)])

    def roll(self, belief: TensorDictBase, plans: Tensor) -> Forecast:
        cars, counts = self._records(belief)
        discrete = self.parameters.ego == EgoKind.DISCRETE
        wanted = 3 if discrete else 4
        given = plans.numpy()
        given = np.broadcast_to(given, (len(cars), *given.shape[-(wanted - 1) :]))
        shape = given.shape[:3]
        if discrete:
            actions, controls = np.ascontiguousarray(given, dtype=np.int64), np.zeros((*shape, 2))
        else:
            actions = np.ones(shape, np.int64)
            controls = np.ascontiguousarray(physical_controls(given.reshape(-1, 2)).reshape(*shape, 2))
        failed, progress = np.zeros(shape[:2], np.int64), np.zeros(shape[:2], np.float32)
        crashed = np.zeros(shape[:2], np.bool_)
        lanes, nothing = belief["lanes"].numpy(), np.zeros((len(cars), 0, 0, 3))
        roll_batch(cars, counts, actions, controls, nothing, lanes, self.parameters, failed, crashed, progress)
        return Forecast(torch.from_numpy(failed), torch.from_numpy(crashed), torch.from_numpy(progress))

    def rehearsal(self, belief: TensorDictBase, copies: int) -> HighwayRehearsal:
        return HighwayRehearsal(self.config, *self._records(belief), belief, copies)

    def _records(self, belief: TensorDictBase) -> tuple[NDArray[np.void], Integers]:
        """A belief as records of the engine [B, N], and the number of known cars [B]."""
        counts = belief["count"].numpy().copy()
        cars = np.zeros((len(counts), self.config.vehicles + 1), dtype=VEHICLE)
        for name in FIELDS:
            cars[name] = belief[name].numpy()
        cars["cos_heading"], cars["sin_heading"] = np.cos(cars["heading"]), np.sin(cars["heading"])
        cars["impact_pair"] = -1
        return cars, counts
