"""The environments that a Stable-Baselines3 model still has: what they say of the world of its training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from bench.driving import DrivingWorld
from bench.errors import UserError
from bench.plugins.pair import Chosen
from bench.scenarios import Grid
from bench.victims.drivers.spaces import UNKNOWN

RESHAPING = ("FlattenObservation", "DtypeObservation")
"""Wrappers that change no number of an observation."""
HARMLESS = ("gymnasium", "stable_baselines3", "bench")
"""Packages whose other wrappers change neither observations nor actions (time limits, statistics, checks)."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """The chain of wrappers of an environment.

    Args:
        inner: the innermost environment.
        changing: names of the wrappers that change observations or actions, from the outside in.
        known: whether all the others are known to change neither.
    """

    inner: Any
    changing: tuple[str, ...]
    known: bool

    @property
    def id(self) -> str:
        """The registered name of the environment; empty if it has none."""
        return str(getattr(getattr(self.inner, "spec", None), "id", "") or "")

    def world_of(self, world: Chosen[Any], grid: Grid, label: Callable[[DrivingWorld], str]) -> str:
        """The world of the training, as tables print it; the name of an environment that is no world; or `unknown`.

        Args:
            world: the world of the run.
            grid: its grid.
            label: the name of a world.

        Raises:
            UserError: if it is the environment of the run's world, with wrappers that the world does not have.
        """
        trained = getattr(self.inner, "world", None)
        if isinstance(trained, DrivingWorld) and type(self.inner).__module__ == "bench.gym.environment":
            self._refuse(self.changing, ())
            return label(trained) if self.known else UNKNOWN
        own = self._of_gym(world.component, grid)
        if own is None or (self.id or type(self.inner)) != (own.id or type(own.inner)):
            return self.id or UNKNOWN
        self._refuse(self.changing, own.changing)
        return str(world) if self.known else UNKNOWN

    def _of_gym(self, world: DrivingWorld, grid: Grid) -> Training | None:
        """The environment of a world that is made of a gymnasium environment."""
        # A model of Stable-Baselines3 comes with gymnasium; a run without one needs none.
        from bench.gym.world import GymWorld

        if not isinstance(world, GymWorld):
            return None
        env = world.environment(grid.cells()[0])
        try:
            return chain(env)
        finally:
            env.close()

    def _refuse(self, found: tuple[str, ...], own: tuple[str, ...]) -> None:
        if found != own:
            other = [name for name in found if name not in own] or list(found) or list(own)
            raise UserError(
                f"the model was trained behind {', '.join(other)}, which the world does not have: train it without, or give "
                "a torch.nn.Module that does the same to the world's observation"
            )


def chain(env: Any) -> Training:
    """The wrappers of an environment of gymnasium."""
    import gymnasium

    changing, known = [], True
    while isinstance(env, gymnasium.Wrapper):
        name = type(env).__name__
        changes = isinstance(env, gymnasium.ObservationWrapper | gymnasium.ActionWrapper) or hasattr(env, "obs_rms")
        if changes and name not in RESHAPING:
            changing.append(name)
        known = known and (changes or type(env).__module__.partition(".")[0] in HARMLESS)
        env = env.env
    return Training(inner=env, changing=tuple(changing), known=known)


def training_of(model: Any) -> Training | None:
    """The environment of a model; None if it has none in this process, or several that differ."""
    env = model.get_env()
    while hasattr(env, "venv"):
        env = env.venv
    found = [chain(one) for one in getattr(env, "envs", ())]
    first = found[0] if found else None
    alike = all(
        (one.id, one.changing, one.known, getattr(one.inner, "world", None))
        == (first.id, first.changing, first.known, getattr(first.inner, "world", None))
        for one in found
        if first is not None
    )
    return first if alike else None
