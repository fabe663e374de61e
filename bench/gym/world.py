"""A world of the benchmark made of a gymnasium environment."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray
from torchrl.envs import EnvBase

from cavbench.driving import ActionType, Driver, DrivingFacts, DrivingWorld
from cavbench.errors import UserError
from cavbench.gym import trial
from cavbench.gym.batch import Batch
from cavbench.gym.declared import native_limits, native_shape
from cavbench.scenarios import Cell

SUCCESS = ("is_success", "success")
"""The names by which environments tell in `info` that the goal is reached."""


@dataclass(frozen=True, kw_only=True)
class GymWorld(DrivingWorld):
    """A world whose episodes are those of a gymnasium environment with a Box observation.

    A subclass sets `axes`, `grid`, `features`, `actions` and `hz`, has a field `max_steps`, and implements `environment`. Its
    `features` declare a name, a range, a unit and a floor for every entry of the observation, of an array in row-major order: the
    range is what the sensor can measure (values outside are clipped), and attacks are limited in these units. Features that
    nobody can forge are named in `features.fixed`. Policies get one row, [1, 1 + n] on the [-1, 1] scale; those from files and
    from Python get the environment's own array (`DrivingFacts.native`).

    The environments are stepped one after the other, so an episode costs what it costs in gymnasium.
    """

    hz: ClassVar[float]
    """Decisions per second. Nothing can check it: it is the rate that defences reckon with."""
    shape: ClassVar[tuple[int, ...]] = ()
    """Shape of the environment's own observation; empty to ask an environment, which is made once for it."""

    @abstractmethod
    def environment(self, cell: Cell) -> gymnasium.Env[Any, Any]:
        """A new environment for a cell. The scenario seed is the `seed` of its `reset`."""

    def progress(self, reward: float, info: Mapping[str, Any]) -> float:
        """The share in [0, 1] of the best possible progress in a step, whose mean is `safe_progress`.

        By default it is the reward, clipped to [0, 1]; a run warns if many rewards are outside.
        """
        return min(max(reward, 0.0), 1.0)

    def failed(self, terminated: bool, info: Mapping[str, Any]) -> bool:
        """Whether the episode has failed, so that its score is 0.

        By default, the first of these that `info` can answer:

        - `crashed` is true: it has failed, at any step;
        - `is_success` or `success` is there: it has failed if it terminates without success;
        - `crashed` is there and false: it has not failed, also if it terminates, because it may have arrived. highway-env also
          tells whether the car is on the road (`rewards["on_road_reward"]`): it has failed if it terminates off it;
        - otherwise it has failed if it terminates. An episode that reaches `max_steps` or is truncated has not.
        """
        if "crashed" in info and np.any(info["crashed"]):
            return True
        for name in SUCCESS:
            if name in info:
                return terminated and not np.all(info[name])
        if "crashed" in info:
            return terminated and not _on_road(info)
        return terminated

    def measured(self, observation: NDArray[np.floating[Any]], info: Mapping[str, Any]) -> Mapping[str, float]:
        """Further truth for the records: `speed` in m/s, `x` in m, `ttc` in s.

        By default the speed is `info["speed"]` if that is there. What is not measured is recorded as 0, 0 and infinity.
        """
        speed = info.get("speed")
        return {"speed": float(speed)} if isinstance(speed, int | float | np.number) else {}

    @property
    def decision_hz(self) -> float:
        return self.hz

    @property
    def facts(self) -> DrivingFacts:
        return DrivingFacts(
            axes=self.axes,
            decision_hz=self.hz,
            max_steps=self.max_steps,
            actions=self.actions,
            features=self.features,
            flat=True,
            shape=native_shape(self),
            limits=native_limits(self),
        )

    def doubts(self, cells: Sequence[Cell]) -> Sequence[str]:
        """What 1,000 random steps say against the declarations of the world (`cavbench.gym.trial`)."""
        return trial.doubts(self, cells)

    def make(
        self,
        cells: Sequence[Cell],
        *,
        action_type: ActionType = "discrete",
        driver: Driver = "agent",
        action_repeat: int = 1,
    ) -> EnvBase:
        """See `cavbench.driving.DrivingWorld.make`; an action is never repeated.

        Raises:
            UserError: if the spaces of an environment are not those that the world declares.
        """
        if driver != "agent" or action_repeat != 1:
            raise UserError(f"{type(self).__name__} has no driver of its own and repeats no actions")
        return Batch(self, cells, action_type)


def _on_road(info: Mapping[str, Any]) -> bool:
    """Whether the car is on the road, as far as highway-env's `info` tells."""
    rewards = info.get("rewards")
    return not isinstance(rewards, Mapping) or bool(rewards.get("on_road_reward", True))
