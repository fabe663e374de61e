"""A planner with perfect information on road networks: it tries plans in copies of the engine, hidden state included."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point
from cavbench.envs.highway.clairvoyant import FAILURE, HORIZON_S, ClairvoyantPlanner
from cavbench.envs.roads.config import TaskKind
from cavbench.envs.roads.engine import PARTS, RoadsEngine, drive
from cavbench.envs.roads.recordings import Recordings
from cavbench.envs.roads.state import Floats, Integers

FAR_S = {TaskKind.EXIT: 10.0}
"""Seconds of a plan where it takes longer to get into the right lane than `HORIZON_S`."""


@entry_point
def roll_batch(
    roads: NDArray[np.void],
    bodies: NDArray[np.void],
    episodes: NDArray[np.void],
    generators: NDArray[np.uint64],
    actions: Integers,
    controls: Floats,
    parameters: NDArray[np.void],
    failed: Integers,
    crashed: NDArray[np.bool_],
    progress: NDArray[np.float32],
    recordings: Recordings,
) -> None:
    """Simulate plans [R, P, T] from the states of R episodes: decisions before a failure, whether it is a crash, progress [R, P].

    Args:
        roads, bodies, episodes, generators, parameters, recordings: as of the engine, of the R episodes.
        actions: [R, P, T] numbers of discrete actions.
        controls: [R, P, T, 3] those of a continuous ego, as `RoadsEngine.controls`; [R, P, 0, 3] for none.
        failed, crashed, progress: outputs.
    """
    given = parameters[0]
    copy, episode = np.empty_like(bodies[0]), np.empty_like(episodes[:1])
    generator, corners = np.empty_like(generators[0]), np.empty((2, 5, 2))
    nothing, parts = np.zeros(3), np.zeros(PARTS)
    for row in range(actions.shape[0]):
        road = roads[episodes[row].network]
        for plan in range(actions.shape[1]):
            copy[:] = bodies[row]
            generator[:] = generators[row]
            episode[:] = episodes[row : row + 1]
            now, total, step = episode[0], 0.0, 0
            while step < actions.shape[2]:
                action = given.actions[actions[row, plan, step]]
                control = controls[row, plan, step] if controls.shape[2] else nothing
                drive(road, copy, now, action, control, given, corners, parts, recordings)
                if now.crashed or now.offroad:
                    break
                total += now.progress
                step += 1
                if now.arrived:
                    step = actions.shape[2]
            failed[row, plan] = step
            crashed[row, plan] = now.crashed
            progress[row, plan] = total


class RoadsPlanner(ClairvoyantPlanner):
    """`ClairvoyantPlanner` on the engine of road networks.

    Args:
        engine: the engine, with discrete actions.
    """

    def __init__(self, engine: RoadsEngine) -> None:
        super().__init__(engine, horizon_s=FAR_S.get(engine.config.task, HORIZON_S))  # type: ignore[arg-type]
        self.roads = engine
        # Within a plan every decision counts, and only a crash or the roadside ends it.
        self.parameters = engine.parameters.copy()
        self.parameters["action_repeat"], self.parameters["max_steps"] = 1, 10**9

    def worth(self, rows: NDArray[np.int64], tried: NDArray[np.int64]) -> NDArray[np.floating]:
        """See `ClairvoyantPlanner.worth`."""
        engine = self.roads
        failed, progress = np.zeros(tried.shape[:2], np.int64), np.zeros(tried.shape[:2], np.float32)
        crashed, controls = np.zeros(failed.shape, np.bool_), np.zeros((*failed.shape, 0, 3))
        roll_batch(
            engine.roads,
            np.ascontiguousarray(engine.bodies[rows]),
            np.ascontiguousarray(engine.episodes[rows]),
            np.ascontiguousarray(engine.generators[rows]),
            tried,
            controls,
            self.parameters,
            failed,
            crashed,
            progress,
            engine.recordings,
        )
        return progress - np.where(failed < self.length, FAILURE - failed, 0.0)
