"""A world of the benchmark made of a gymnasium environment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from torchrl.envs import EnvBase

from cavbench.driving import Control, DrivingFacts
from cavbench.driving.gym import trial
from cavbench.driving.gym.batch import Batch
from cavbench.driving.gym.declaration import Declaration
from cavbench.driving.gym.declared import native_limits, native_shape
from cavbench.errors import UserError
from cavbench.scenarios import Cell


@lru_cache(maxsize=16)
def _doubts(world: Declaration, cells: tuple[Cell, ...]) -> tuple[str, ...]:
    """A training that is scored again and again has one world: what it declares does not change."""
    return tuple(trial.doubts(world, cells))


@dataclass(frozen=True, kw_only=True)
class GymWorld(Declaration):
    """A world whose episodes are those of a gymnasium environment with a Box observation.

    A subclass sets `axes`, `grid`, `features`, `actions` and `hz`, has a field `max_steps`, and implements `environment`. Its
    `features` declare a name, a range, a unit and a floor for every entry of the observation, of an array in row-major order: the
    range is what the sensor can measure (values outside are clipped), and attacks are limited in these units. Features that
    nobody can forge are named in `features.fixed`. Policies get one row, [1, 1 + n] on the [-1, 1] scale; those from files and
    from Python get the environment's own array (`DrivingFacts.native`).

    The environments are stepped one after the other, so an episode costs what it costs in gymnasium.
    """

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
            # An environment takes one kind of actions.
            controls=() if self.actions else self.controls,
        )

    def doubts(self, cells: Sequence[Cell]) -> Sequence[str]:
        """What 1,000 random steps say against the declarations of the world (`cavbench.driving.gym.trial`); asked once."""
        try:
            hash(self)
        # A field of a subclass may have none.
        except TypeError:
            return trial.doubts(self, cells)
        return _doubts(self, tuple(cells))

    def build(self, cells: Sequence[Cell], control: Control) -> EnvBase:
        """See `cavbench.driving.DrivingWorld.build`; an action is never repeated.

        Raises:
            UserError: if the spaces of an environment are not those that the world declares.
        """
        if control.driver != "agent" or control.action_repeat != 1:
            raise UserError(
                f"{self.label} has no driver of its own and repeats no actions, as bench train needs: train with any library in "
                "cavbench.gym.make(world), or in the environment itself"
            )
        return Batch(self, cells, control.action_type)
