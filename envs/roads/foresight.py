"""Straight parallel lanes for attackers: beliefs from observations, forecasts from beliefs, on the engine of road networks.

An observation has no target speeds and lanes. The ego's target speed follows from its last two speeds, that of another car is its
speed. A car aims for the lane where it will be soon. Cars follow IDM and keep to that lane.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench.compiled import entry_point
from cavbench.driving.dynamics import Dynamics, Forecast, Rehearsal
from cavbench.envs.highway.config import ACTIONS
from cavbench.envs.highway.dynamics import GAIN_SPEED
from cavbench.envs.highway.ego import nearest_target_speed
from cavbench.envs.highway.engine import Flag, Number
from cavbench.envs.roads.bodies import put_body
from cavbench.envs.roads.clairvoyant import roll_batch
from cavbench.envs.roads.config import RoadsConfig, parameters
from cavbench.envs.roads.engine import RoadsEngine
from cavbench.envs.roads.generator import WORDS
from cavbench.envs.roads.recordings import NOTHING
from cavbench.envs.roads.replay import IDM, OBSTACLE, send_away
from cavbench.envs.roads.state import BODY, EPISODE, Floats, Integers

FIELDS = ("x", "y", "heading", "speed", "target_speed", "target_y")
"""What a belief holds of each car; the first one is the ego."""
LOOK_AHEAD_S = 0.8
"""A car aims for the lane in which it will be after so many seconds."""
PRESENCE, X, Y, VX, VY = range(5)
"""Columns of an observation."""


@entry_point
def place_batch(
    roads: NDArray[np.void],
    episodes: NDArray[np.void],
    fields: Floats,
    counts: Integers,
    bodies: NDArray[np.void],
    parameters: NDArray[np.void],
) -> None:
    """Put the cars of beliefs [B, N, 6], of which the first `counts` [B] are known, on the roads of their episodes."""
    given = parameters[0]
    for row in range(episodes.size):
        road = roads[episodes[row].network]
        for number in range(bodies.shape[1]):
            body, car = bodies[row, number], fields[row, number]
            put_body(road, body, given.ego if number == 0 else IDM, car[0], car[1], car[2], car[3])
            if number >= counts[row]:
                send_away(body, OBSTACLE)
                continue
            body.target_speed, body.changes_lanes = car[4], False
            body.speed_index = nearest_target_speed(car[4], given.target_speeds[: given.speeds])
            near = np.inf
            for lane in range(road.lane_count):
                if abs(road.lanes[lane].start_y - car[5]) < near:
                    body.target_lane, near = lane, abs(road.lanes[lane].start_y - car[5])


class RoadsDynamics(Dynamics):
    """The rules of motion on straight parallel lanes.

    Args:
        config: configuration with the road of each episode, which is no secret. What was recorded is not looked at.
    """

    def __init__(self, config: RoadsConfig) -> None:
        scenes = tuple(replace(scene, recordings=NOTHING) for scene in config.scenes)
        self.config = replace(config, scenes=scenes, action_repeat=1, driver="agent", max_steps=10**9)
        self.parameters = parameters(self.config)
        self.action_type, self.period = config.action_type, 1 / config.policy_frequency
        self.actions = len(ACTIONS) if config.action_type == "discrete" else 0
        self._engine = engine = RoadsEngine(self.config)
        self.roads, self._networks = engine.roads, engine.episodes["network"].copy()
        # An observation does not say how far the end of the road is.
        self.roads["end"] = np.inf
        assert config.low is not None
        assert config.high is not None
        low, high = np.array(config.low), np.array(config.high)
        self._half, self._centre = (high - low) / 2, (high + low) / 2

    def unknown(self) -> TensorDict:
        batch, size = self.config.batch, self.config.observed_vehicles
        road = {
            "network": torch.from_numpy(self._networks.astype(np.int64)),
            "sensor_range": torch.tensor([scene.sensor_range for scene in self.config.scenes], dtype=torch.float64),
        }
        cars = {name: torch.zeros((batch, size), dtype=torch.float64) for name in FIELDS}
        return TensorDict({**cars, **road, "count": torch.zeros(batch, dtype=torch.int64)}, batch_size=[batch])

    def believe(self, observation: Tensor, before: TensorDictBase) -> TensorDict:
        rows = observation.numpy().astype(np.float64)
        measured = rows[..., X:] * self._half + self._centre
        there = rows[..., PRESENCE] > 0
        measured[:, 1:] += measured[:, :1]
        x, y, vx, vy = (measured[..., column] for column in range(4))
        speed = np.hypot(vx, vy)
        heading = np.where(speed > 0, np.arctan2(vy, vx), 0.0)
        aimed = speed.copy()
        aimed[:, 0] = self._aimed(speed[:, 0], before["speed"].numpy()[:, 0], before["count"].numpy() > 0)
        cars = dict(zip(FIELDS, (x, y, heading, speed, aimed, y + LOOK_AHEAD_S * vy), strict=True))
        # Rows without a car come last.
        fields = {name: torch.from_numpy(np.where(there, values, 0.0)) for name, values in cars.items()}
        road = {name: before[name] for name in ("network", "sensor_range")}
        count = torch.from_numpy(there.sum(1).astype(np.int64))
        return TensorDict({**fields, **road, "count": count}, batch_size=[len(rows)])

    def _aimed(self, now: Floats, before: Floats, known: NDArray[np.bool_]) -> Floats:
        """The target speed [B] of the ego: the one of the table that explains its last two speeds."""
        kept = (1 - GAIN_SPEED / self.config.simulation_frequency) ** self.config.substeps
        wanted = np.where(known, (now - before * kept) / (1 - kept), now)
        table = np.array(self.config.target_speeds)
        if self.action_type == "continuous":
            return now
        return np.asarray(table[np.abs(wanted[:, None] - table).argmin(1)], dtype=np.float64)

    def roll(self, belief: TensorDictBase, plans: Tensor) -> Forecast:
        bodies, episodes = self.placed(belief)
        wanted = 3 if self.actions else 4
        given = np.broadcast_to(plans.numpy(), (len(episodes), *plans.shape[-(wanted - 1) :]))
        shape = given.shape[:3]
        actions, controls = np.ones(shape, np.int64), np.zeros((*shape, 3))
        if self.actions:
            actions = np.ascontiguousarray(given, dtype=np.int64)
        else:
            controls = self._engine.controls(given.reshape(-1, 2)).reshape(*shape, 3)
        failed, progress = np.zeros(shape[:2], np.int64), np.zeros(shape[:2], np.float32)
        crashed, generators = np.zeros(shape[:2], np.bool_), np.zeros((len(episodes), WORDS), np.uint64)
        roll_batch(
            self.roads,
            bodies,
            episodes,
            generators,
            actions,
            controls,
            self.parameters,
            failed,
            crashed,
            progress,
            NOTHING,
        )
        return Forecast(torch.from_numpy(failed), torch.from_numpy(crashed), torch.from_numpy(progress))

    def rehearsal(self, belief: TensorDictBase, copies: int) -> Rehearsal:
        return RoadsRehearsal(self, belief, copies)

    def placed(self, belief: TensorDictBase) -> tuple[NDArray[np.void], NDArray[np.void]]:
        """Bodies [B, V] and episodes [B] that begin with a belief."""
        counts = belief["count"].numpy()
        bodies = np.zeros((len(counts), self.config.observed_vehicles), dtype=BODY)
        episodes = np.zeros(len(counts), dtype=EPISODE)
        episodes["network"] = belief["network"].numpy()
        episodes["sensor_range"] = belief["sensor_range"].numpy()
        episodes["cars"] = episodes["bodies"] = bodies.shape[1]
        episodes["pace"] = self.roads["lanes"]["speed_limit"][episodes["network"], 0]
        episodes["ahead"] = belief["x"].numpy()[:, 0]
        fields = np.stack([belief[name].numpy() for name in FIELDS], -1)
        place_batch(self.roads, episodes, np.ascontiguousarray(fields), counts, bodies, self.parameters)
        return bodies, episodes


class RoadsRehearsal(Rehearsal):
    """Copies of straight roads that start from beliefs.

    Args:
        dynamics: the rules of motion.
        belief: of B episodes.
        copies: copies of each episode.
    """

    def __init__(self, dynamics: RoadsDynamics, belief: TensorDictBase, copies: int) -> None:
        bodies, episodes = dynamics.placed(belief)
        self.shape = (copies, len(episodes))
        scenes = dynamics.config.scenes[:1] * (copies * len(episodes))
        self.engine = RoadsEngine(replace(dynamics.config, scenes=scenes))
        self.engine.roads, self.engine.parameters = dynamics.roads, dynamics.parameters
        self.engine.bodies, self.engine.episodes = np.tile(bodies, (copies, 1)), np.tile(episodes, copies)
        self.engine.look()
        self._read()

    def step(self, action: Tensor) -> None:
        self.engine.step(action.flatten(0, 1).numpy())
        self._read()

    def _read(self) -> None:
        engine = self.engine
        self.observation = torch.from_numpy(engine.observation.copy()).unflatten(0, self.shape)
        self.progress = torch.from_numpy(engine.numbers[Number.PROGRESS].copy()).unflatten(0, self.shape)
        failed = engine.flags[Flag.CRASHED] | engine.flags[Flag.OFFROAD]
        self.failed = torch.from_numpy(failed).unflatten(0, self.shape)
