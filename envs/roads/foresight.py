"""Networks of lanes for attackers: beliefs from observations, and forecasts from beliefs by the engine of road networks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench.driving.dynamics import Dynamics, Forecast, Rehearsal
from cavbench.envs.highway.config import ACTIONS
from cavbench.envs.highway.engine import Flag, Number
from cavbench.envs.roads.belief import FIELDS, guess_routes, place_batch, track_batch
from cavbench.envs.roads.clairvoyant import roll_batch
from cavbench.envs.roads.config import RoadsConfig, TaskKind, parameters
from cavbench.envs.roads.engine import RoadsEngine
from cavbench.envs.roads.generator import WORDS
from cavbench.envs.roads.intersection_rules import SECONDS_BEFORE
from cavbench.envs.roads.network import MOST_LANES
from cavbench.envs.roads.recordings import NOTHING
from cavbench.envs.roads.state import BODY, EPISODE, Floats, Integers

DESTINATIONS = {
    TaskKind.ROUNDABOUT: (6, 3),
    TaskKind.INTERSECTION: (4, 4),
    TaskKind.EXIT: (1, 1),
    TaskKind.U_TURN: (1, 1),
}
"""The destinations of a task's roads, and how many of them, the first ones, are those of the other cars."""
ROAD = ("network", "goal", "sensor_range", "noise_sigma")
"""What a belief holds of the road."""
NEVER = -1.0
"""The chance that a car comes in a simulation: nobody knows when."""


class RoadsDynamics(Dynamics):
    """The rules of motion on a network of lanes, for observations that are rows of x, y, vx, vy.

    Args:
        config: configuration with the road of each episode and its ego's destination, which are no secret. What was recorded is
            not looked at.
        changes_lanes: whether the other cars change lanes.
    """

    def __init__(self, config: RoadsConfig, *, changes_lanes: bool) -> None:
        scenes = tuple(replace(scene, recordings=NOTHING) for scene in config.scenes)
        self.config = replace(config, scenes=scenes, action_repeat=1, driver="agent", max_steps=10**9)
        self.parameters = parameters(self.config)
        self.parameters["full_steps"] = config.max_steps
        self.changes_lanes, self.slots = changes_lanes, max(scene.capacity for scene in scenes)
        self.action_type, self.period = config.action_type, 1 / config.policy_frequency
        self.actions = len(ACTIONS) if config.action_type == "discrete" else 0
        self._engine = engine = RoadsEngine(self.config)
        self.roads, self._networks = engine.roads, engine.episodes["network"].copy()
        self._begin = SECONDS_BEFORE * config.simulation_frequency if config.task == TaskKind.INTERSECTION else 0
        self._guesses: Integers | None = None
        assert config.low is not None
        assert config.high is not None
        low, high = np.array(config.low), np.array(config.high)
        self._half, self._centre = (high - low) / 2, (high + low) / 2

    def unknown(self) -> TensorDict:
        batch, scenes = self.config.batch, self.config.scenes
        road = {
            "network": torch.from_numpy(self._networks.astype(np.int64)),
            "goal": torch.tensor([scene.goal for scene in scenes]),
            "sensor_range": torch.tensor([scene.sensor_range for scene in scenes], dtype=torch.float64),
            "noise_sigma": torch.tensor([scene.noise_sigma for scene in scenes], dtype=torch.float64),
        }
        cars = {name: torch.zeros((batch, self.slots), dtype=torch.float64) for name in FIELDS}
        steps, count = (torch.zeros(batch, dtype=torch.int64) for _ in range(2))
        return TensorDict({**cars, **road, "steps": steps, "count": count}, batch_size=[batch])

    def believe(self, observation: Tensor, before: TensorDictBase) -> TensorDict:
        rows = observation.numpy().astype(np.float64)
        clipped = np.trunc(rows[..., 1:]).astype(np.int8)
        rows[..., 1:] = rows[..., 1:] * self._half + self._centre
        bodies, episodes = self.placed(before)
        episodes["noise_sigma"] = before["noise_sigma"].numpy()
        fields = np.zeros((len(rows), self.slots, len(FIELDS)))
        track_batch(self.roads, bodies, episodes, rows, clipped, self.parameters, fields)
        return self.believed(fields, episodes["cars"], before, steps=episodes["steps"])

    def believed(self, fields: Floats, count: Integers, before: TensorDictBase, *, steps: Integers) -> TensorDict:
        """The belief [B] with cars [B, N, 8], of which the first `count` [B] are known, after `steps` [B] decisions."""
        cars = {name: torch.from_numpy(np.ascontiguousarray(fields[..., place])) for place, name in enumerate(FIELDS)}
        road = {name: before[name] for name in ROAD}
        numbers = {"count": count, "steps": steps}
        rest = {name: torch.from_numpy(np.array(values, dtype=np.int64)) for name, values in numbers.items()}
        return TensorDict({**cars, **road, **rest}, batch_size=[len(fields)])

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
        # Who arrives is given the progress of all steps that are left, beyond the plan.
        progress = np.minimum(progress, np.float32(shape[2]))
        return Forecast(torch.from_numpy(failed), torch.from_numpy(crashed), torch.from_numpy(progress))

    def rehearsal(self, belief: TensorDictBase, copies: int) -> Rehearsal:
        return RoadsRehearsal(self, belief, copies)

    def placed(self, belief: TensorDictBase) -> tuple[NDArray[np.void], NDArray[np.void]]:
        """Bodies [B, N + 1] and episodes [B] that begin with a belief; the last body is for an obstacle."""
        counts = belief["count"].numpy()
        bodies = np.zeros((len(counts), self.slots + 1), dtype=BODY)
        episodes = np.zeros(len(counts), dtype=EPISODE)
        for name in ("network", "goal", "sensor_range", "steps"):
            episodes[name] = belief[name].numpy()
        episodes["cars"], episodes["arrivals"] = counts, NEVER
        episodes["frames"] = self._begin + episodes["steps"] * self.config.substeps
        episodes["pace"] = self.roads["lanes"]["speed_limit"][episodes["network"], 0]
        fields = np.stack([belief[name].numpy() for name in FIELDS], -1)
        guesses = self._routes()
        place_batch(
            self.roads, episodes, fields, self._own(belief), guesses, self.changes_lanes, bodies, self.parameters
        )
        return bodies, episodes

    def _routes(self) -> Integers:
        """[R, L] the routes that are guessed of other cars, by network and lane; made when they are first needed."""
        if self._guesses is None:
            self._guesses = np.full((len(self.roads), MOST_LANES), -1)
            if self.config.task in DESTINATIONS:
                guess_routes(self.roads, *DESTINATIONS[self.config.task], self._guesses)
        return self._guesses

    def _own(self, belief: TensorDictBase) -> Integers:
        """[B, L] the route of the ego from each lane; -1 without one."""
        goal = belief["goal"].numpy()[:, None]
        if self.config.task not in DESTINATIONS or self.config.task == TaskKind.EXIT:
            return np.full((len(goal), MOST_LANES), -1)
        return np.arange(MOST_LANES) * DESTINATIONS[self.config.task][0] + goal


class RoadsRehearsal(Rehearsal):
    """Copies of roads that start from beliefs.

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
