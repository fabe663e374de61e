"""The environments that a Stable-Baselines3 model still has: what they say of the world of its training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from bench.driving import DrivingWorld
from bench.errors import UserError
from bench.plugins.content import content
from bench.plugins.pair import Chosen
from bench.scenarios import Grid
from bench.victims.drivers.spaces import UNKNOWN

RESHAPING = ("FlattenObservation", "DtypeObservation")
"""Wrappers that change no number of an observation."""
HARMLESS = (
    *("OrderEnforcing", "PassiveEnvChecker", "TimeLimit", "Autoreset", "RecordEpisodeStatistics", "RecordVideo"),
    *("HumanRendering", "RenderCollection", "AddWhiteNoise", "ObstructView", "NormalizeReward", "Monitor"),
    *("VecMonitor", "VecCheckNan", "VecVideoRecorder"),
)
"""Wrappers of `LIBRARIES` that change neither observations, actions nor the rate of decisions."""
LIBRARIES = ("gymnasium", "stable_baselines3")
"""Their other wrappers change one of these."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """The chain of wrappers of an environment.

    Args:
        inner: the innermost environment.
        changing: names of the wrappers that change observations, actions or the rate of decisions, from the outside in.
        settings: a hash of the arguments and of the statistics of each.
        known: whether all the others are known to change nothing.
    """

    inner: Any
    changing: tuple[str, ...]
    settings: tuple[str, ...]
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
            self._refuse(None)
            return label(trained) if self.known else UNKNOWN
        own = self._of_gym(world.component, grid)
        if own is None or (self.id or type(self.inner)) != (own.id or type(own.inner)):
            return self.id or UNKNOWN
        self._refuse(own)
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

    def _refuse(self, own: Training | None) -> None:
        """Refuse wrappers that the environment of the world, if it is made of one, does not have."""
        wrapped = own.changing if own else ()
        instead = "train it without, or give a torch.nn.Module that does the same to the world's observation"
        if (found := self.changing) != wrapped:
            other = [name for name in found if name not in wrapped] or list(found) or list(wrapped)
            raise UserError(
                f"the model was trained behind {', '.join(other)}, which the world does not have: {instead}"
            )
        for name, here, there in zip(found, self.settings, own.settings if own else (), strict=True):
            if here != there:
                raise UserError(
                    f"the model was trained behind {name} with other settings or statistics than in the world: {instead}"
                )


def chain(env: Any) -> Training:
    """The wrappers of an environment of gymnasium."""
    import gymnasium

    changing, known = [], True
    while isinstance(env, gymnasium.Wrapper):
        changes = isinstance(env, gymnasium.ObservationWrapper | gymnasium.ActionWrapper) or hasattr(env, "obs_rms")
        harmless = isinstance(env, gymnasium.RewardWrapper) or type(env).__name__ in (*HARMLESS, *RESHAPING)
        ours = _package(env) in LIBRARIES
        if (changes and type(env).__name__ not in RESHAPING) or (ours and not harmless):
            changing.append(env)
        known = known and (changes or ours)
        env = env.env
    return Training(
        inner=env,
        changing=tuple(type(one).__name__ for one in changing),
        settings=tuple(_settings(one) for one in changing),
        known=known,
    )


def _settings(wrapper: Any) -> str:
    """A hash of the arguments that gymnasium keeps of a wrapper, and of its statistics."""
    statistics = getattr(wrapper, "obs_rms", None)
    return content([getattr(wrapper, "_saved_kwargs", None), statistics and [statistics.mean, statistics.var]])


def _package(wrapper: Any) -> str:
    return type(wrapper).__module__.partition(".")[0]


def training_of(model: Any) -> Training | None:
    """The environment of a model; None if it has none in this process, or several that differ."""
    env, changing, known = model.get_env(), [], True
    while hasattr(env, "venv"):
        name = type(env).__name__
        # The statistics of the outermost one are used.
        normalises = name == "VecNormalize" and env.norm_obs and env is not model.get_vec_normalize_env()
        harmless = name in HARMLESS or (name == "VecNormalize" and not normalises)
        if _package(env) in LIBRARIES and not harmless:
            changing.append(name)
        known = known and _package(env) in LIBRARIES
        env = env.venv
    found = [chain(one) for one in getattr(env, "envs", ())]
    first = found[0] if found else None
    alike = all(
        (one.id, one.changing, one.known, getattr(one.inner, "world", None))
        == (first.id, first.changing, first.known, getattr(first.inner, "world", None))
        for one in found
        if first is not None
    )
    if first is None or not alike:
        return None
    return replace(
        first,
        changing=(*changing, *first.changing),
        settings=(*[content(name) for name in changing], *first.settings),
        known=known and first.known,
    )
