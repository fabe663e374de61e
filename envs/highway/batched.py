"""The default environment, on the compiled engine: identical to highway-env and several hundred times faster."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.highway.clairvoyant import ClairvoyantPlanner
from cavbench.envs.highway.config import HighwayConfig
from cavbench.envs.highway.engine import HighwayEngine
from cavbench.envs.highway.environment import HighwayEnv


class BatchedHighway(HighwayEnv):
    """`HighwayEnv` on `HighwayEngine`.

    >>> env = BatchedHighway(HighwayConfig(cells=(Cell(lanes=3, density=1.0),) * 64))
    >>> env.rollout(450, break_when_all_done=True)
    """

    def __init__(self, config: HighwayConfig) -> None:
        super().__init__(config)
        self.engine = HighwayEngine(config)
        self.clairvoyant = ClairvoyantPlanner(self.engine) if config.driver == "clairvoyant" else None

    def _start(self, chosen: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        self.engine.reset(chosen, seeds)

    def _drive(self, action: NDArray[np.generic], paused: NDArray[np.bool_] | None) -> None:
        self.engine.step(action if self.clairvoyant is None else self.clairvoyant.actions(), paused)

    def _order(self, orders: NDArray[np.float64], paused: NDArray[np.bool_] | None) -> None:
        self.engine.order_cars(orders, paused)

    def _view(self) -> NDArray[np.float64]:
        return view_of(self.engine)

    def _outputs(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        return self.engine.observation, self.engine.numbers, self.engine.flags


def view_of(engine: HighwayEngine) -> NDArray[np.float64]:
    """[B, N, 7] the cars as `cavbench.driving.traffic.View` has them."""
    cars = engine.vehicles
    lanes = np.broadcast_to(engine.episodes["lanes"][:, None], cars.shape)
    columns = (
        cars["x"] - cars["x"][:, :1],
        cars["y"],
        cars["speed"],
        cars["heading"],
        cars["crashed"],
        cars["ordered"],
        lanes,
    )
    return np.stack(columns, -1, dtype=np.float64, casting="unsafe")
