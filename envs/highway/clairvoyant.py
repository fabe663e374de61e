"""A planner with perfect information: it tries plans in copies of the simulator, hidden state included (random shooting)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.highway.ego import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, SLOWER
from cavbench.envs.highway.engine import HighwayEngine
from cavbench.envs.highway.forecast import roll_batch

HORIZON_S, SEGMENT_S, HELD_S = 4.0, 0.8, 1 / 3
"""Seconds of a plan, of its parts, and for which it is carried out before the next one is chosen."""
PLANS, LIBRARY = 64, 1024
"""Plans that are tried at a time, and that there are; each choice tries the next ones."""
CHANCES = {LANE_LEFT: 0.15, IDLE: 0.15, LANE_RIGHT: 0.15, FASTER: 0.4, SLOWER: 0.15}
"""How often a part of a plan is each action. A lane change is sent once."""
FAILURE = 1e3
"""Cost of a crash or of leaving the road within the plan; a later one costs less."""


class ClairvoyantPlanner:
    """Chooses the actions of every episode of an engine by model-predictive control.

    The state is copied with all its hidden parts and the world is deterministic, so a plan that is chosen works out. The rest of
    the plan before is always among those that are tried.

    Args:
        engine: the engine, with discrete actions.
        orders: [B, T, N, 3] the orders to cars that an attacker drives, of each decision of the episode, if they are known;
            otherwise the cars are taken to go on as they were ordered last.
        horizon_s: seconds of a plan.
    """

    def __init__(
        self, engine: HighwayEngine, orders: NDArray[np.float64] | None = None, horizon_s: float = HORIZON_S
    ) -> None:
        hz = engine.config.policy_frequency
        self.engine, self.orders = engine, orders
        self.length, self.held = round(horizon_s * hz), max(1, round(HELD_S * hz))
        segment = max(1, round(SEGMENT_S * hz))
        self.library = _library(self.length, segment)
        self.simple = [np.full(self.length, action) for action in (FASTER, IDLE, SLOWER)]
        if horizon_s > HORIZON_S:
            # Nobody finds by chance the one lane that a way needs, many lanes away.
            at = np.arange(self.length) % segment == 0
            self.simple += [np.where(at, side, IDLE) for side in (LANE_LEFT, LANE_RIGHT)]
        self.plan = np.full((engine.config.batch, self.length), IDLE, dtype=np.int64)

    def actions(self) -> NDArray[np.int64]:
        """The actions [B] in the current states."""
        steps = self.engine.episodes["steps"]
        running = ~(self.engine.episodes["terminated"] | self.engine.episodes["truncated"])
        due = np.flatnonzero((steps % self.held == 0) & running)
        if len(due):
            self._choose(due)
        return self.plan[np.arange(len(steps)), steps % self.held]

    def _choose(self, rows: NDArray[np.int64]) -> None:
        """Choose the plans of the episodes `rows`."""
        steps = self.engine.episodes["steps"][rows]
        turn = (steps // self.held)[:, None] * PLANS + np.arange(PLANS)
        tried = self.library[turn % LIBRARY]
        begun = (steps > 0)[:, None]
        rest = np.roll(self.plan[rows], -self.held, axis=1)
        rest[:, -self.held :] = IDLE
        tried[:, 0] = np.where(begun, rest, IDLE)
        for place, plan in enumerate(self.simple, start=1):
            tried[:, place] = plan
        self.plan[rows] = tried[np.arange(len(rows)), self.worth(rows, tried).argmax(1)]

    def worth(self, rows: NDArray[np.int64], tried: NDArray[np.int64]) -> NDArray[np.floating]:
        """[R, P] how far plans [R, P, length] would bring the episodes `rows` [R], less the cost of a failure."""
        cars = np.ascontiguousarray(self.engine.vehicles[rows])
        failed = np.zeros(tried.shape[:2], np.int64)
        crashed, progress = np.zeros(failed.shape, np.bool_), np.zeros(failed.shape, np.float32)
        counts = np.full(len(rows), cars.shape[1], np.int64)
        controls = np.zeros((*tried.shape, 2))
        lanes = self.engine.episodes["lanes"][rows].astype(np.int64)
        orders = self._known(rows)
        roll_batch(cars, counts, tried, controls, orders, lanes, self.engine.parameters, failed, crashed, progress)
        return progress - np.where(failed < self.length, FAILURE - failed, 0.0)

    def _known(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """[R, length, N, 3] the orders of the next decisions, none after their end; [R, 0, 0, 3] if they are not known."""
        if self.orders is None:
            return np.zeros((len(rows), 0, 0, 3))
        places = self.engine.episodes["steps"][rows][:, None] + np.arange(self.length)
        last = self.orders.shape[1] - 1
        found = self.orders[rows[:, None], np.minimum(places, last)]
        return np.ascontiguousarray(np.where((places <= last)[..., None, None], found, 0.0))


def _library(length: int, segment: int) -> NDArray[np.int64]:
    """[LIBRARY, length] random plans, always the same."""
    generator = np.random.default_rng(0)
    parts = generator.choice(list(CHANCES), size=(LIBRARY, -(-length // segment)), p=list(CHANCES.values()))
    plans = np.repeat(parts, segment, axis=1)[:, :length]
    sideways = np.isin(plans, (LANE_LEFT, LANE_RIGHT))
    first = np.arange(length) % segment == 0
    return np.ascontiguousarray(np.where(sideways & ~first, FASTER, plans), dtype=np.int64)
