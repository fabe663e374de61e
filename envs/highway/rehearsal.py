"""Simulated episodes for attackers, decision by decision, on the compiled engine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from cavbench.driving.dynamics import Rehearsal
from cavbench.driving.sets import Traffic
from cavbench.driving.traffic import View
from cavbench.envs.highway.config import HighwayConfig
from cavbench.envs.highway.engine import Flag, HighwayEngine, Number, observe_batch
from cavbench.envs.highway.state import Integers
from cavbench.envs.highway.state import bounds as bounds_of

FAR_BEHIND, APART = 5000.0, 60.0
"""Cars that were never seen stand so far behind, in m, and so far from each other."""
SAME_CAR = 2.5
"""A car of the belief is the one of the traffic that is so near, in m."""
UNSEEN_SPEED = 20.0
"""Their speed in m/s."""


class HighwayRehearsal(Rehearsal):
    """Copies of the highway that start from beliefs.

    Args:
        config: configuration of the world.
        cars: beliefs as records of the engine, [B, N].
        counts: number of known cars [B]; the first ones of each row.
        belief: lanes and sensor range of the B episodes.
        copies: copies of each episode.
    """

    def __init__(
        self, config: HighwayConfig, cars: NDArray[np.void], counts: Integers, belief: TensorDictBase, copies: int
    ) -> None:
        batch, size = cars.shape
        number = np.arange(size)
        unseen = number >= counts[:, None]
        cars["x"] = np.where(unseen, -FAR_BEHIND - APART * number, cars["x"])
        cars["cos_heading"] = np.where(unseen, 1.0, cars["cos_heading"])
        for name in ("speed", "target_speed"):
            cars[name] = np.where(unseen, UNSEEN_SPEED, cars[name])
        self.shape = (copies, batch)
        self.engine = HighwayEngine(replace(config, cells=config.cells[:1] * (copies * batch), action_repeat=1))
        episodes = self.engine.episodes
        self.engine.vehicles[:] = np.tile(cars, (copies, 1))
        self.engine.order[:] = np.argsort(self.engine.vehicles["x"], 1, kind="stable")
        episodes["lanes"] = np.tile(belief["lanes"].numpy(), copies)
        episodes["sensor_range"] = np.tile(belief["sensor_range"].numpy(), copies)
        episodes["noise_sigma"], episodes["truncated"] = 0.0, False
        observe_batch(
            self.engine.vehicles,
            self.engine.order,
            episodes,
            np.arange(copies * batch),
            self.engine.parameters,
            self.engine.observation,
            self.engine.numbers,
            self.engine.flags,
        )
        self._numbers: Integers | None = None
        self._read()

    def step(self, action: Tensor) -> None:
        self.engine.step(action.flatten(0, 1).numpy())
        self._read()

    def order(self, orders: Tensor, view: View, bounds: Traffic) -> None:
        if self._numbers is None:
            self._numbers = self._matched(view)
            self.engine.parameters = self.engine.parameters._replace(bounds=bounds_of(bounds))
        copies, batch = self.shape
        given = orders.flatten(0, 1).numpy()
        mine = np.zeros((copies * batch, *self.engine.vehicles.shape[1:], given.shape[-1]))
        number = np.tile(self._numbers, (copies, 1))
        row, car = np.nonzero(number > 0)
        mine[row, number[row, car]] = given[row, car]
        self.engine.order_cars(mine)

    def _matched(self, view: View) -> Integers:
        """[B, N] the number here of each car of the view, 0 where the belief does not have it."""
        cars = self.engine.vehicles[: self.shape[1]]
        along, across = cars["x"] - cars["x"][:, :1], cars["y"]
        off = np.abs(view.x.numpy()[:, :, None] - along[:, None]) + np.abs(view.y.numpy()[:, :, None] - across[:, None])
        nearest = off.argmin(2)
        return np.where(off.min(2) < SAME_CAR, nearest, 0)

    def _read(self) -> None:
        engine = self.engine
        self.observation = torch.from_numpy(engine.observation.copy()).unflatten(0, self.shape)
        self.progress = torch.from_numpy(engine.numbers[Number.PROGRESS].copy()).unflatten(0, self.shape)
        self.failed = torch.from_numpy(engine.flags[Flag.TERMINATED].copy()).unflatten(0, self.shape)
