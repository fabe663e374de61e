"""What a world declares of its gymnasium environment, and how it reads what the environment returns."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import gymnasium
import numpy as np
from numpy.typing import NDArray

from cavbench.driving.contracts import DrivingWorld
from cavbench.driving.features import CONTROLS
from cavbench.scenarios import Cell

SUCCESS = ("is_success", "success")
"""The names by which environments tell in `info` that the goal is reached."""
REWARD = "reward"
"""The reward of the step, which `info` also has."""
Ending = Literal["unknown", "failure", "success", "reward"]


@dataclass(frozen=True, kw_only=True)
class Declaration(DrivingWorld):
    """The part of `GymWorld` that its author writes."""

    hz: ClassVar[float]
    """Decisions per second. Nothing can check it: it is the rate that defences reckon with."""
    shape: ClassVar[tuple[int, ...]] = ()
    """Shape of the environment's own observation; empty to ask an environment, which is made once for it."""
    ranges_known: ClassVar[bool] = False
    """Whether the ranges are those that the authors of the environment state, and not guesses."""
    controls: ClassVar[tuple[str, ...]] = CONTROLS
    """Names of the entries of the environment's action, if it is a Box."""
    terminated: ClassVar[Ending] = "unknown"
    """What it means that the environment terminates an episode and `info` does not say it: `failure`, as a fallen pole;
    `success`, as a goal that is reached; `reward`: success if the last reward is above 0. `unknown` counts as a failure, and a
    run says so."""

    @abstractmethod
    def environment(self, cell: Cell) -> gymnasium.Env[Any, Any]:
        """A new environment for a cell. The scenario seed is the `seed` of its `reset`."""

    def progress(self, reward: float, info: Mapping[str, Any]) -> float:
        """The share in [0, 1] of the best possible progress in a step, whose mean is `safe_progress`.

        By default it is the reward, clipped to [0, 1]; a run warns if many rewards are outside. An episode that terminates
        without failing has arrived: each step that is left counts as 1.
        """
        return min(max(reward, 0.0), 1.0)

    def failed(self, terminated: bool, info: Mapping[str, Any]) -> bool:
        """Whether the episode has failed, so that its score is 0.

        By default, the first of these that `info` can answer:

        - `crashed` is true: it has failed, at any step;
        - `is_success` or `success` is there: it has failed if it terminates without success;
        - `crashed` is there and false: it has not failed, also if it terminates, because it may have arrived. highway-env also
          tells whether the car is on the road (`rewards["on_road_reward"]`): it has failed if it terminates off it;
        - otherwise `terminated` of the world says what an episode is that terminates. One that reaches `max_steps` or is
          truncated has not failed.

        Args:
            terminated: whether the environment has terminated the episode in this step.
            info: what it tells, and the reward of the step as `reward` unless it uses that name itself.
        """
        if "crashed" in info and np.any(info["crashed"]):
            return True
        for name in SUCCESS:
            if name in info:
                return terminated and not np.all(info[name])
        if "crashed" in info:
            return terminated and not _on_road(info)
        ending = self.ending
        return terminated and ending != "success" and not (ending == "reward" and info[REWARD] > 0)

    @property
    def ending(self) -> Ending:
        """`terminated`, or what is known of the environment."""
        return self.terminated

    def measured(self, observation: NDArray[np.floating[Any]], info: Mapping[str, Any]) -> Mapping[str, float]:
        """Further truth for the records: `speed` in m/s, `x` in m, `ttc` in s.

        By default the speed is `info["speed"]` if that is there. What is not measured is recorded as 0, 0 and infinity.
        """
        speed = info.get("speed")
        return {"speed": float(speed)} if isinstance(speed, int | float | np.number) else {}

    @property
    def label(self) -> str:
        """What messages call it."""
        return type(self).__name__

    @property
    def source(self) -> str:
        """What makes its environments, in a message."""
        return f"{self.label}.environment"

    def writes(self, name: str, value: object) -> str:
        """What its author writes to declare something."""
        return f"{name}={value!r} in the class"

    @property
    def clips_rewards(self) -> bool:
        """Whether `progress` is the reward as it is, clipped."""
        return type(self).progress is Declaration.progress

    def writes_ranges(self) -> str:
        """What its author does about ranges that are wrong."""
        return "write features.low and high in the units of the environment"

    def writes_progress(self) -> str:
        """What its author does about rewards that are no shares."""
        return f"override progress() of {type(self).__name__}"

    @property
    def decision_hz(self) -> float:
        return self.hz


def _on_road(info: Mapping[str, Any]) -> bool:
    """Whether the car is on the road, as far as highway-env's `info` tells."""
    rewards = info.get("rewards")
    return not isinstance(rewards, Mapping) or bool(rewards.get("on_road_reward", True))
